"""Test faults that need their own bridge: no devices, another device, link, clock or key, or a reader."""

import os
import time
from collections.abc import Callable
from itertools import count, pairwise
from pathlib import Path

import pytest
from checks import Measured, records, replays, soon
from devices import Ear, ftp, open_line
from rig import Rig

from magbridge.bridge.events import HostClock
from magbridge.link.files import FTP_HEADER, Opcode

MakeRig = Callable[..., Rig]
KEY = bytes(range(32))


def test_neither_sensor_nor_autopilot_at_the_start(make_rig: MakeRig, measured: Measured) -> None:
    rig = make_rig("tcp")
    rig.process = rig.spawn(rig.config)
    rig.until(lambda: rig.logs and rig.logs[0].stat().st_size > 500)
    rig.run(0.5)
    assert rig.process.poll() is None
    rig.fluxgate.plug()
    rig.autopilot.up()
    back = rig.until_well()
    measured(recovers_s=back)
    assert back < soon(3.0)
    replays(rig)
    (log,) = rig.logs
    texts = [one.message["text"] for one in records(log) if one.message.name == "STATUSTEXT"]
    assert any(text.startswith("digitizer lost: no such device: /") for text in texts)
    assert any(text.startswith(f"link: Connection refused: {rig.url[:8]}") for text in texts)


@pytest.mark.parametrize("speaks", [True, False])
def test_another_device_fits_the_pattern_too(make_rig: MakeRig, measured: Measured, speaks: bool) -> None:
    """The pattern also matches a GPS, found before the sensor, and again after the sensor was unplugged."""
    rig = make_rig()
    gps, far = open_line(rig.fluxgate.folder / "ttyUSB0")
    if speaks:
        os.write(gps, 40 * b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")
    rig.fluxgate.plug("ttyUSB1")
    found = rig.start()
    rig.fluxgate.unplug()
    rig.until_status(lambda status: status["sensor_state"] != 1)
    rig.fluxgate.plug("ttyUSB2")
    back = rig.until_well()
    measured(found_s=found, recovers_s=back)
    assert found < soon(5.0)
    assert back < soon(2.0)
    replays(rig)
    os.close(gps)
    os.close(far)


@pytest.mark.parametrize(
    ("link", "away_s", "text", "within_s"),
    [
        ("udpout", 5.7, "autopilot 1:1 found", 1.5),  # silent for more than 5 s
        ("tcp", 1.2, "link: open", 2.0),
        ("serial", 1.0, "link: ", 2.0),  # "open", or that this text itself was not sent
    ],
)
def test_the_autopilot_s_end_of_the_link_closes_and_opens_again(
    make_rig: MakeRig, measured: Measured, link: str, away_s: float, text: str, within_s: float
) -> None:
    rig = make_rig(link)
    rig.start()
    rig.until_answered()
    before, mark, away = rig.fresh_status(), rig.mark, time.monotonic()
    last, made = rig.of("MAG_FIELD")[-1]["sequence"], rig.fluxgate.encoder.sequence
    rig.autopilot.down()
    rig.run(away_s)
    assert rig.process is not None
    assert rig.process.poll() is None
    rig.autopilot.up()
    back = rig.until_well()
    rig.until_reported(text, mark)
    after = rig.fresh_status()
    still = 50 * rig.machine.seconds(away, time.monotonic())
    sequences = [message["sequence"] for message in rig.of("MAG_FIELD", mark)]
    lost = next(number for number in sequences if number > last + 20) - last - 1
    assert sequences == sorted(sequences)
    assert 50 * (away_s - 0.5) <= lost <= 100 * away_s + still
    came = after["samples"] - before["samples"]  # the bridge went on measuring
    on_the_way = 25 + still  # half a second
    assert came == pytest.approx(rig.fluxgate.encoder.sequence - made, abs=on_the_way)
    assert after["samples_lost"] == before["samples_lost"]
    measured(recovers_s=back, messages_lost=lost)
    assert back < soon(within_s)
    replays(rig)


def test_a_serial_line_that_is_too_slow(make_rig: MakeRig, measured: Measured) -> None:
    """The line has no reader until the buffer of the operating system is full."""
    rig = make_rig("serial")
    rig.start()
    mark, deadline = rig.mark, time.monotonic() + 60.0
    while not texts_in(rig.logs, "link: too slow"):
        assert time.monotonic() < deadline
        for _ in range(100):
            rig.fluxgate.turn()
            time.sleep(0.005)
    back = rig.until_well()
    rig.until_reported("bytes not sent so far", mark, 30.0)
    measured(recovers_s=back)
    assert back < soon(5.0)
    replays(rig)


def texts_in(logs: list[Path], text: str) -> bool:
    """Return True if a bridge has sent `text`, as far as its log is on the disk."""
    return any(text.encode() in path.read_bytes() for path in logs)


def test_host_clock_set_forward_and_back(make_rig: MakeRig, measured: Measured) -> None:
    rig = make_rig(stepped=True)
    rig.start()
    mark = rig.mark
    for step in (3600.0, -7200.0):
        before = rig.of("MAG_FIELD")[-1]
        seen = rig.mark
        rig.step(step)
        noticed = rig.until_reported("clock was set by", seen)
        # less than the threshold is slewing, and so may a late look at one of two clocks be off
        (reported,) = [float(text.split()[-2]) for text in rig.texts(seen) if "clock was set by" in text]
        assert reported == pytest.approx(step, abs=HostClock.THRESHOLD_US * 1e-6)
        rig.run(0.2)
        after = rig.of("MAG_FIELD")[-1]
        elapsed = (after["time_usec"] - before["time_usec"]) * 1e-6
        samples = (after["sequence"] - before["sequence"]) / 50
        assert elapsed == pytest.approx(step + samples, abs=0.1)
        assert noticed < soon(1.5)
    assert rig.undue_flags(mark) == ""
    assert rig.status["samples_lost"] == 0
    (log,) = rig.logs
    times = [record.time_us for record in records(log)]
    assert times == sorted(times)
    measured(noticed_s=noticed)
    replays(rig)


# ---- A station reads a log while the bridge measures -------------------------------------------------------


LOG = "20250101T000000Z_0001.tlog"


def replies(station: Ear, mark: int) -> list[tuple[int, int, bytes]]:
    """Return opcode, end of burst (bool) and data of each FTP reply received since a position."""
    found = []
    for message in station.of("FILE_TRANSFER_PROTOCOL", mark):
        _, _, opcode, size, _, complete, _ = FTP_HEADER.unpack_from(message["payload"])
        found.append((opcode, complete, message["payload"][12 : 12 + size]))
    return found


@pytest.mark.parametrize("key", [None, KEY])
def test_a_log_is_read_while_the_bridge_measures(make_rig: MakeRig, key: bytes | None) -> None:
    rig = make_rig("udpin", key=key)
    (rig.folder / "logs").mkdir()
    content = bytes(range(251)) * 600
    (rig.folder / "logs" / LOG).write_bytes(content)
    rig.start()
    mark, before = rig.mark, rig.fresh_status()
    station, sequence = Ear(255, key, rig.autopilot.address), count(1)

    def ask(opcode: int, data: bytes = b"", **options: int) -> list[tuple[int, int, bytes]]:
        """Send an FTP request; return its replies, which end with the burst or with a negative reply."""
        start = len(station.received)
        station.send_message("FILE_TRANSFER_PROTOCOL", **ftp(opcode, data, next(sequence), **options))
        end = {(Opcode.NAK, 0), (Opcode.ACK, 1), (Opcode.ACK, int(opcode == Opcode.BURST))}
        rig.until(lambda: any((kind, done) in end for kind, done, _ in replies(station, start)))
        return replies(station, start)

    station.send_message("HEARTBEAT", type=6, autopilot=8)
    size = len(content).to_bytes(4, "little")
    assert ask(Opcode.OPEN_READ, f"@MAV_LOG/{LOG}".encode()) == [(Opcode.ACK, 0, size)]
    data = b""
    while len(data) < len(content):
        burst = ask(Opcode.BURST, size=239, offset=len(data))
        data += b"".join(piece for kind, _, piece in burst if kind == Opcode.ACK)
    assert data == content
    assert [kind for kind, _, _ in ask(Opcode.OPEN_READ, b"../key.bin")] == [Opcode.NAK]
    rig.until_reported("file for 255:190 refused: file not found", mark)
    station.send_message("LOG_REQUEST_LIST", target_system=1, target_component=191, end=0xFFFF)
    rig.until(lambda: station.of("LOG_ENTRY"))
    station.send_message("LOG_REQUEST_DATA", target_system=1, target_component=191, id=1, count=900)
    rig.until(lambda: len(station.of("LOG_DATA")) == 10)
    assert b"".join(one["data"] for one in station.of("LOG_DATA")) == content[:900]
    station.send_message("LOG_ERASE", target_system=1, target_component=191)
    rig.until_reported("logs are not erased over the link", mark)
    assert (rig.folder / "logs" / LOG).read_bytes() == content
    after = rig.fresh_status()
    assert after["samples_lost"] == before["samples_lost"]
    assert rig.undue_flags(mark) == ""
    # no other peer got the file, and its frames are numbered without a gap
    assert not rig.of("FILE_TRANSFER_PROTOCOL", mark)
    numbers = [one.sequence for one in station.received if one.system == 1]
    assert all((b - a) % 256 == 1 for a, b in pairwise(numbers))
    station.line.close()
    (rig.folder / "logs" / LOG).unlink()
    assert sum(path.stat().st_size for path in rig.logs) < len(content) * 4
    replays(rig)
