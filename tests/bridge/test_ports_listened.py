"""Test that the bridge identifies the device on a serial line by its bytes, on real pseudo-terminals."""

import json
import os
import pty
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import reduce
from operator import xor
from pathlib import Path

import pytest
from commands import Command
from devices import serial_line

from magbridge.bridge import devices as devices_of_bridge
from magbridge.bridge.check import findings
from magbridge.bridge.init import Answers, bridge_toml
from magbridge.bridge.ports import listen, recognise
from magbridge.config import load
from magbridge.errors import PortError
from magbridge.mavlink import Codec
from magbridge.sensors.options import driver_names, options_of


def nmea(text: str) -> bytes:
    return f"${text}*{reduce(xor, text.encode()):02X}\r\n".encode()


def hmr(k: int) -> bytes:
    return f" 12,3{k:02}  - 1,045   23,100\r".encode()


SPEAKERS = {
    "nmea": b"".join(nmea(f"GPGGA,12000{k},4736.0,N,05242.0,W") for k in range(5)),
    "mavlink": 5 * Codec(7, 1).pack("HEARTBEAT", type=1, autopilot=3, system_status=4, mavlink_version=3),
    "hmr2300": b"".join(hmr(k) for k in range(9)),
    "text": b"".join(f"B={k}.5 X 1 2 3\r\n".encode() for k in range(9)),
    "bytes": bytes(range(128, 250)) * 3,
    "": b"",
}


@contextmanager
def speaking(data: bytes) -> Iterator[str]:
    """Yield a pseudo-terminal on which a device sends `data` repeatedly."""
    stop = threading.Event()

    with serial_line() as (master, name):

        def send_message() -> None:
            while not stop.wait(0.02):
                if data:
                    os.write(master, data)

        talker = threading.Thread(target=send_message)
        talker.start()
        try:
            yield name
        finally:
            stop.set()
            talker.join()


@pytest.mark.parametrize(
    ("who", "text"),
    [
        ("nmea", "NMEA 0183: GPGGA"),
        ("mavlink", "system 7 component 1"),
        ("hmr2300", ""),
        ("text", "not understood: 'B=4.5 X 1 2 3' (driver ascii reads it, if x y z are among these)"),
        ("bytes", "80 81 82"),
        ("", "silent"),
    ],
)
def test_the_sender_on_a_line_is_recognised_and_described(who: str, text: str) -> None:
    with speaking(SPEAKERS[who]) as device:
        received, baudrate, _ = listen(device, (9600,), 0.4)
    assert received.who == who
    assert baudrate == (9600 if who else None)
    assert text in recognise(SPEAKERS[who], 1.0).text


def test_ports_as_a_command(command: Command) -> None:
    with speaking(SPEAKERS["nmea"]) as device:
        options = "--seconds", "0.3", "--baudrate", "9600", "--json"
        output = command("ports", device, "/dev/no_such", *options, code=1)  # one cannot be opened
    first, second = json.loads(output.out)["ports"]
    assert (first["who"], first["said"], first["baudrate"]) == ("nmea", "NMEA 0183: GPGGA", 9600)
    assert "cannot be opened" in second["said"] or "may not be opened" in second["said"]


def test_a_busy_port_is_reported_as_such() -> None:
    code = (
        "import serial, sys; line = serial.Serial(sys.argv[1], exclusive=True); print(1, flush=True); input()"
    )
    with (
        serial_line() as (_, name),
        subprocess.Popen(
            [sys.executable, "-c", code, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other,
    ):
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(PortError) as refused:
            listen(name, (9600,), 0.1)
        other.communicate(b"\n")
    assert refused.value.reason.startswith("busy: ")


@pytest.mark.parametrize("driver", driver_names())
def test_every_option_of_a_driver_is_reported(driver: str, command: Command) -> None:
    output = command("drivers", driver).out
    for one in options_of(driver):
        assert one.name in output
        assert one.kind
        assert one.meaning, one.name


@pytest.mark.parametrize(
    ("driver", "options"),
    [
        ("hmr2300", ()),
        ("twinleaf", ()),
        ("digitizer", ("--option", "sensitivity=5e-5")),
        ("ascii", ("--option", 'columns=["x", "y", "z"]', "--option", "unit=uT")),
    ],
)
def test_init_writes_what_run_would_start_with(
    driver: str, options: tuple[str, ...], here: Path, command: Command
) -> None:
    command("init", "--driver", driver, "--port", "loop://", "--parameter", "battpos [in]", *options)
    config = load("bridge.toml")
    assert "`" not in Path("bridge.toml").read_text()
    assert config.telemetry["battpos"].unit == "in"
    assert not [one for one in findings(Path("bridge.toml")) if one.fatal]
    assert "would start" in command("run", "--check", "--config", "bridge.toml").out
    assert "exists already and is not overwritten" in command.refuses("init", code=2)
    assert not (here / "logs").exists()


def test_init_offers_a_port_on_which_the_sensor_can_be(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices_of_bridge, "find_spec", lambda _: True)  # the library of the bus
    command("init", "--driver", "rm3100")
    assert load("bridge.toml").sensor.port == "i2c:1:0x20"


def test_init_names_the_autopilots_own_message_of_a_parameter() -> None:
    text = bridge_toml(Answers("hmr2300", "/dev/ttyUSB0", parameters=("battery_current [A]", "battpos [in]")))
    telemetry = tomllib.loads(text)["telemetry"]
    current, mass = telemetry["battery_current"], telemetry["battpos"]
    assert (current["message"], current["field"], current["scale"]) == ("SYS_STATUS", "current_battery", 0.01)
    assert (mass["message"], mass["match"]) == ("NAMED_VALUE_FLOAT", {"name": "battpos"})


def test_init_says_what_is_left_to_fill_in(command: Command) -> None:
    output = command("init", "--driver", "digitizer")
    assert "sensor.options.sensitivity: missing key" in output.err
    assert "FILL IN" in Path("bridge.toml").read_text()
    assert "1 error, " in command("run", "--check", "--config", "bridge.toml", code=2).err


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (b"hmr2300\nloop://\n\n7\nbattpos [in]\n", "bridge.toml: written; next: magbridge run --check"),
        (
            b"hmr2300\nloop://\n\nseven\n",
            "system id: expected a number from 1 to 255, got 'seven'; nothing is written",
        ),
        (b"hmr2300\nloop://\n\x04", "expected an answer, got the end of the input; nothing is written"),
    ],
    ids=["answered", "no number", "Ctrl-D"],
)
def test_init_asks_five_questions_on_a_terminal(typed: bytes, words: str, here: Path) -> None:
    master, slave = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "magbridge", "init"], stdin=slave, stdout=slave, stderr=slave, cwd=here
    ) as process:
        os.close(slave)
        os.write(master, typed)
        output = b""
        with suppress(OSError):  # the terminal ends with its last program
            while piece := os.read(master, 4096):
                output += piece
    os.close(master)
    text = output.decode()
    assert words in text
    assert "Traceback" not in text
    written = (here / "bridge.toml").exists()
    assert written == (process.returncode == 0)
    if written:
        assert load("bridge.toml").link.system == 7
        assert load("bridge.toml").telemetry["battpos"].unit == "in"
