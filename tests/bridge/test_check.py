"""Test ``run --check``, which lists the errors of a configuration, and ``--live``, which tests the ports."""

import os
import pty
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread

import pytest
from commands import Command
from rig import Rig
from small import bridge_text

from magbridge.bridge import check
from magbridge.bridge.check import Arrived, LiveCheck, findings
from magbridge.calibration.file import save
from magbridge.calibration.model import CalibratedSensor, Calibration, Parameter, identity
from magbridge.calibration.terms import Polynomial
from magbridge.config import load
from magbridge.mavlink import spec
from magbridge.mavlink.enums import MAV_CMD, MAV_RESULT

GOOD = bridge_text("hmr2300", "", masses={"battpos": "in"})


def of(*names: str) -> Calibration:
    """Return a calibration that needs the given parameters, in inches."""
    parameters = tuple(Parameter(name, "in", -1.0, 1.0, 0.0, 1.0) for name in names)
    terms = (Polynomial(exponents=((0,) * len(names),)),)
    return replace(identity(), sensor=CalibratedSensor("hmr2300"), parameters=parameters, terms=terms)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    save(of("battpos"), tmp_path / "cal.json")
    path = tmp_path / "bridge.toml"
    path.write_text(GOOD)
    return path


def lines(config: Path, *, fatal: bool | None = None) -> list[str]:
    found = [one for one in findings(config) if fatal is None or one.fatal == fatal]
    return [one.text.removeprefix(f"{config}: ") for one in found]


def test_all_findings_come_at_once(config: Path) -> None:
    text = GOOD.replace('"/dev/null"', '"/dev/no_such_device"\nbaudrat = 1')
    text = text.replace("options = {}", "options = {rate = 21, speed = 3}")
    text = text.replace("udpout:127.0.0.1:14550", "udp:127.0.0.1:1").replace("cal.json", "none.json")
    text = text.replace("NAMED_VALUE_FLOAT", "NAMED_VALUE")
    config.write_text(text + "[publish]\nMAG_FELD = 1\nMAG_RAW = 1e9\n[lgo]\n")
    texts = "\n".join(lines(config, fatal=True))
    for words in (
        "sensor.baudrat: unknown key; did you mean baudrate?",
        "lgo: unknown key; did you mean log?",
        "sensor.options.rate: expected one of 10, 20,",
        "sensor.options.speed: unknown key",
        "link.url: expected udpin, udpout",
        "telemetry.battpos.message: unknown MAVLink message 'NAMED_VALUE'",
        "calibration.file: no such file",
        "publish.MAG_FELD: expected one of",
        "publish.MAG_RAW: expected a rate from",
    ):
        assert words in texts
    assert any("no /dev/no_such_device now" in line for line in lines(config, fatal=False))


def test_each_parameter_that_is_lacking(config: Path) -> None:
    save(of("fin", "battpos", "ballast"), config.parent / "cal.json")
    config.write_text(GOOD.replace('unit = "in"', 'unit = "cm"'))
    assert lines(config, fatal=True) == [
        "telemetry.fin: missing: the calibration needs this parameter",
        "telemetry.battpos.unit: expected 'in', the calibration's unit, not 'cm'",
        "telemetry.ballast: missing: the calibration needs this parameter",
    ]


BARE = GOOD.replace('[calibration]\nfile = "cal.json"\n', "")


@pytest.mark.parametrize(
    ("text", "is_fatal", "words"),
    [
        (GOOD.replace("cal.json", "."), True, "expected a file, not a directory"),
        (GOOD.replace("cal.json", "."), True, "calibration.file: "),
        (BARE + '[learning]\nprior = "bridge.toml"', True, "learning.prior: "),
        (BARE + '[learning]\nreference = "bridge.toml"', True, "learning.reference: "),
        (BARE + "[learning]\nranges = {fin = [0.0, 1.0]}", True, "telemetry.fin: missing"),
        (GOOD + '[learning]\nreference = "none.nc"', True, "learning.reference: no such file"),
        (GOOD + '[learning]\nprior = "none.json"', True, "learning.prior: no such file"),
        (GOOD + "[learning]\nranges = {battpos = [1.0, -1.0]}", True, "ranges.battpos"),
        (GOOD + "[learning]\nmax_rate = 0.0", True, "learning.max_rate"),
        (GOOD + "[learning]\nspeed = 3", True, "learning.speed: unknown key"),
        (GOOD + '[heading]\nsend = "gps"', True, "heading.send: expected one of 'odometry', 'vision_"),
        (GOOD + "[heading]\nrat = 1", True, "heading.rat: unknown key"),
        (GOOD + '[heading]\nnmea = "udp:nowhere"', True, "heading.nmea: expected HOST:PORT or [IPV6]:PORT"),
        (BARE + '[navigation]\nmap = "none.nc"\nfix = "TELEPATHY"', True, "navigation.fix: expected one of"),
        (GOOD.replace("hmr2300", "twinleaf"), False, "every sample would be uncalibrated"),
        (GOOD.replace('"logs"', '"bridge.toml"'), False, "bridge.toml is a file"),
    ],
)
def test_what_run_would_end_at_or_warn_of(text: str, is_fatal: bool, words: str, config: Path) -> None:
    config.write_text(text)
    assert any(words in line for line in lines(config, fatal=is_fatal))


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("udpout:127.0.0.1:14550", "", "link.url: expected `str` of length >= 1, got ''"),
        ("[link]", "[link]\nsystem = 0", "link.system: expected `int` >= 1, got 0"),
        ("[link]", "[publish]\nMAG_RAW = nan\n[link]", "publish.MAG_RAW: expected `float` >= "),
        ("[link]", "[link]\ncomponent = 1", "link.component: expected another number than the autopilot's"),
        ('"hmr2300"', '"ascii"\noptions.columns = ["x"]', "sensor.options.columns: expected x, y and z,"),
        ("udpout:127.0.0.1:14550", "/dev/null", "sensor.port: expected another device than link.url, got"),
    ],
)
def test_a_wrong_value_is_one_error(config: Path, old: str, new: str, error: str) -> None:
    config.write_text(GOOD.replace("options = {}\n", "").replace(old, new))
    (line,) = lines(config, fatal=True)
    assert line.startswith(error)


def test_two_sensors_are_two_devices(tmp_path: Path) -> None:
    (tmp_path / "tty").symlink_to("/dev/null")
    names = {"a": "/dev/null", "b": str(tmp_path / "tty")}
    sensors = [f'[sensor.{name}]\ndriver = "ascii"\nport = "{port}"' for name, port in names.items()]
    path = tmp_path / "bridge.toml"
    path.write_text("\n".join([*sensors, '[link]\nurl = "udpout:127.0.0.1:14550"']))
    expected = f"expected another device than sensor.a.port, got {names['b']!r}"
    assert lines(path, fatal=True) == [f"sensor.b.port: {expected}"]


@pytest.mark.parametrize("more", ["", '[learning]\nreference = "grid.nc"', '[navigation]\nmap = "grid.nc"'])
def test_a_damaged_file_ends_run_as_a_wrong_configuration(config: Path, more: str, command: Command) -> None:
    """The service unit does not restart after exit code 2."""
    (config.parent / ("grid.nc" if more else "cal.json")).write_text("damaged")
    config.write_text(GOOD + more)
    command.refuses("run", "--config", config, code=2)
    config.write_text("[sensor")
    assert "expected TOML" in command.refuses("run", "--config", config, code=2)
    assert "expected TOML" in command("run", "--check", "--config", config, code=2).err


@pytest.mark.parametrize(
    "text", ["", "x = ", "[sensor]\n", "sensor = 3\nlink = 4\n", "[sensor]\ndriver = 'none'\n"]
)
def test_whatever_the_file_there_are_lines(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bridge.toml"
    path.write_text(text)
    assert all(one.startswith(str(path)) for one in (found.text for found in findings(path)))
    assert [one for one in findings(path) if one.fatal]


def test_a_device_that_may_not_be_opened_says_which_group(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda name, _: str(name) != "/dev/null")
    (line,) = [line for line in lines(config) if line.startswith("sensor.port")]
    assert line.startswith("sensor.port: /dev/null may not be opened by this user: it belongs to the group ")
    assert "sudo usermod -aG" in line


LISTEN_S = 4.0


class Sender:
    """Autopilot that replies to a bridge's requests and sends ATTITUDE at the requested rate."""

    def __init__(self, rig: Rig, result: int) -> None:
        self._rig, self._result, self._mark = rig, result, 0
        self._period, self._due = 1.0, 0.0
        self.asked: list[str] = []

    def turn(self, now: float) -> None:
        for message in self._rig.of("COMMAND_LONG", self._mark):
            assert message["command"] == MAV_CMD.SET_MESSAGE_INTERVAL
            self.asked.append(spec(int(message["param1"])).name)
            if self._result == MAV_RESULT.ACCEPTED and self.asked[-1] == "ATTITUDE":
                self._period = message["param2"] * 1e-6
            answer = {"command": MAV_CMD.SET_MESSAGE_INTERVAL, "result": self._result}
            self._rig.autopilot.send_message("COMMAND_ACK", **answer)
        self._mark = self._rig.mark
        if now >= self._due:
            self._due = now + self._period
            self._rig.autopilot.send_message("ATTITUDE", time_boot_ms=self._rig.autopilot.boot_us // 1000)


def listened(rig: Rig, result: int = MAV_RESULT.ACCEPTED) -> tuple[LiveCheck, Sender]:
    """Check the ports of a rig while its sensor and its autopilot send."""
    sender, check = Sender(rig, result), LiveCheck(load(rig.config), LISTEN_S)
    thread = Thread(target=check.listen)
    rig.fluxgate.plug()
    rig.autopilot.up()
    thread.start()

    def ended() -> bool:
        sender.turn(time.monotonic())
        return not thread.is_alive()

    rig.until(ended)
    return check, sender


def by_name(check: LiveCheck) -> dict[str, Arrived]:
    return {one.name: one for one in check.arrived}


def test_live_lists_the_rates_that_arrive_and_requests_those_that_are_needed(
    make_rig: Callable[..., Rig],
) -> None:
    rig = make_rig()
    check, sender = listened(rig)
    arrived = by_name(check)
    assert "ATTITUDE" in sender.asked
    assert arrived["ATTITUDE"].needed_hz == 4.0
    assert arrived["ATTITUDE"].rate_hz == pytest.approx(4.0, rel=0.5)
    assert arrived["NAMED_VALUE_FLOAT"].rate_hz > 5.0
    assert arrived["NAMED_VALUE_FLOAT"].sender == "1:1"
    assert check.readings_hz["digitizer"] > 10.0
    assert {message.name for _, message in rig.received} <= {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG"}
    texts = [one.text.removeprefix(f"{rig.config}: ") for one in check.faults]
    (text,) = [text for text in texts if text.startswith(("link:", "telemetry", "sensor"))]
    assert text.startswith("link: GLOBAL_POSITION_INT does not arrive and is needed at 1 Hz: set SRn_POS")
    assert text.endswith(" to 1, or request it of PX4 by `mavlink stream -s GLOBAL_POSITION_INT -r 1`")
    assert not any(one.fatal for one in check.faults)
    assert not (rig.folder / "logs").exists()


def test_live_reports_silent_ports(
    make_rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    rig = make_rig()
    monkeypatch.setattr(check, "LISTEN_TIME_S", 1.0)
    out, err = command("run", "--check", "--live", "--config", rig.config)
    assert "sensor digitizer: 0 readings/s" in out
    assert "link: no HEARTBEAT of 1:1 and no other message: check link.url" in err
    assert "sensor: digitizer: no reading in 1 s: the port is not open" in err
    assert "the bridge would start, " in out
    command("run", "--live", "--config", rig.config, code=2)


def test_a_unit_that_only_the_calibration_states_is_reported(config: Path) -> None:
    expected = "telemetry.battpos.unit: none: not compared with 'in', the calibration's"
    config.write_text(GOOD.replace('unit = "in"', ""))
    assert expected in lines(config, fatal=False)
    config.write_text(GOOD)
    assert not any(".unit" in line for line in lines(config))


TWICE = (
    GOOD
    + """
[telemetry.ballast]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
"""
)


def test_a_source_that_two_parameters_share_is_an_error(config: Path) -> None:
    config.write_text(TWICE)
    (text,) = lines(config, fatal=True)
    assert text.startswith("telemetry.ballast: expected other values than telemetry.battpos")
    for other in ("scale = -1.0", "component = 7"):
        config.write_text(TWICE + other)
        assert not lines(config, fatal=True)


@pytest.mark.parametrize(
    ("message", "key", "match"), [("NAMED_VALUE_INT", "name", '"ballast"'), ("DEBUG", "ind", "7")]
)
def test_a_message_with_a_name_needs_a_match(config: Path, message: str, key: str, match: str) -> None:
    table = f'[telemetry.ballast]\nmessage = "{message}"\nfield = "value"\n'
    expected = f"telemetry.ballast.match: none: every {message} is used, with any {key}; add {key} = ..."
    config.write_text(f"{GOOD}\n{table}")
    assert expected in lines(config, fatal=False)
    config.write_text(f"{GOOD}\n{table}match = {{{key} = {match}}}")
    assert not any("match" in line for line in lines(config))


def test_live_names_a_wrong_rate_the_systems_that_send_and_telemetry_that_does_not_match(
    make_rig: Callable[..., Rig],
) -> None:
    rig = make_rig(sensor=("ascii", 'columns = ["x", "y", "z"]\nrate = 1.0'), hz=20.0)
    text = rig.config.read_text()
    rig.config.write_text(text.replace('{name = "battpos"}', '{name = "ballast"}'))
    check, _ = listened(rig)
    assert any("ascii sends " in one.text and "readings/s, but rate = 1" in one.text for one in check.faults)
    (fault,) = [one.text for one in check.faults if "telemetry.battpos: " in one.text]
    assert "NAMED_VALUE_FLOAT of component 1 does not match" in fault
    assert fault.endswith(", got name = 'battpos'")
    rig.config.write_text(text.replace("[link]", "[link]\nsystem = 7"))
    check = LiveCheck(load(rig.config), 2.0)
    thread = Thread(target=check.listen)
    thread.start()
    rig.until(lambda: not thread.is_alive())
    assert any("no HEARTBEAT of 7:1, but messages of 1:1" in one.text for one in check.faults)


# ---- The output of a bridge that a user starts in a terminal -----------------------------------------------


CONFIG = bridge_text(
    "hmr2300", "", port="/dev/ttyNo", url="udpout:127.0.0.1:9", masses={}, calibration=False, log=False
)


WANTED = ("until Ctrl-C", "no calibration: raw field", "hmr2300 lost: No such file or directory: /dev/ttyNo")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_terminal_gets_the_state_of_the_link(tmp_path: Path, number: signal.Signals) -> None:
    """The terminal shows the state until the bridge receives a signal or the terminal is closed."""
    with on_a_terminal(tmp_path, end=number) as terminal:
        read_until(terminal, WANTED)


def test_a_calibration_that_its_data_do_not_support_is_reported(tmp_path: Path) -> None:
    save(replace(identity(), method="nominal", warnings=("few headings",)), tmp_path / "cal.json")
    with on_a_terminal(tmp_path, '[calibration]\nfile = "cal.json"') as terminal:
        read_until(terminal, ("calibration is not supported by its data",))


def test_a_terminal_that_hangs_does_not_stop_the_bridge(tmp_path: Path) -> None:
    """Ctrl-S, or a connection that is gone: the bridge runs, and ends at a signal."""
    with on_a_terminal(tmp_path, '[log]\ndirectory = "."') as terminal:
        read_until(terminal, WANTED[:1])
        os.write(terminal, b"\x13")
        deadline = time.monotonic() + 60.0
        while not any(b"hmr2300 lost" in path.read_bytes() for path in tmp_path.glob("*.tlog")):
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_a_service_tells_the_journal_how_severe_it_is(tmp_path: Path) -> None:
    """To systemd's journal, standard error is a socket that JOURNAL_STREAM names."""
    (tmp_path / "bridge.toml").write_text(CONFIG)
    ours, theirs = socket.socketpair()
    end = theirs.fileno()
    status = os.fstat(end)
    environment = os.environ | {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
    command = [sys.executable, "-m", "magbridge", "run", "--config", "bridge.toml"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=end, env=environment) as process, theirs, ours:
        try:
            read_until(ours.fileno(), ("<4>no calibration: raw field\n", "<3>hmr2300 lost: No such file or"))
        finally:
            process.terminate()
    assert process.returncode == 0


@pytest.mark.parametrize("content", ['{"parameters": {"MB_GAP_F', None])
def test_kept_parameters_that_cannot_be_read_keep_no_vehicle_ashore(
    tmp_path: Path, content: str | None
) -> None:
    """An unreadable file is renamed; a folder of this name stays."""
    kept = tmp_path / "bridge.parameters.json"
    kept.write_text(content) if content else kept.mkdir()
    with on_a_terminal(tmp_path) as terminal:
        read_until(terminal, (*WANTED, "cannot be read, not used: bridge.parameters.json"))
    aside = tmp_path / "bridge.parameters.json.damaged"
    assert kept.is_dir() if content is None else aside.read_text() == content


@contextmanager
def on_a_terminal(folder: Path, more: str = "", end: signal.Signals = signal.SIGTERM) -> Iterator[int]:
    """Start a bridge on a terminal and yield the terminal's far end; end it by the signal `end`."""
    (folder / "bridge.toml").write_text(CONFIG + more)
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "magbridge", "run", "--config", "bridge.toml"]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = subprocess.Popen(command, cwd=folder, stderr=theirs, env=buffered)
    os.close(theirs)
    os.set_blocking(ours, False)
    try:
        yield ours
        process.send_signal(end)
        assert process.wait(30.0) == 0
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def read_until(terminal: int, wanted: tuple[str, ...]) -> None:
    """Read until the whole text has come; a busy machine takes seconds to start a bridge."""
    seen, deadline = "", time.monotonic() + 60.0
    while not all(words in seen for words in wanted):
        assert time.monotonic() < deadline, seen
        if select.select([terminal], [], [], 0.05)[0]:
            seen += os.read(terminal, 4096).decode()
