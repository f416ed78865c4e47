"""Faults that need their own bridge: another link, another clock, a key, a disk, an abrupt end."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from checks import Row, first_difference, replays
from devices import open_line
from rig import Rig

from magbridge.bridge.events import Clock
from magbridge.logs import read
from magbridge.mavlink import Codec, LogReader, Signing
from magbridge.records import Channel
from sitl.own_log import is_own_log, runs
from sitl.replay import agreement

MakeRig = Callable[..., Rig]
KEY = bytes(range(32))
LOG_OK, LOG_FAILED = 1, 2


def test_neither_sensor_nor_autopilot_at_the_start(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig("tcp")
    rig.process = rig.spawn(rig.config)
    rig.until(lambda: rig.logs and rig.logs[0].stat().st_size > 500)
    rig.run(0.5)
    assert rig.process.poll() is None
    rig.fluxgate.plug()
    rig.autopilot.up()
    back = rig.until_well()
    table(
        "started with neither sensor nor autopilot there",
        "into the log: both lines lost, with the reasons; it tries to open them every 0.25 s",
        f"{back:.2f} s after both came",
        "nothing",
    )
    assert back < 3.0
    replays(rig)
    (log,) = rig.logs
    with log.open("rb") as file:
        said = [record.message["text"] for record in LogReader(file) if record.message.name == "STATUSTEXT"]
    assert any(text.startswith("digitizer lost: no such device: /") for text in said)
    assert any(text.startswith(f"link: Connection refused: {rig.url[:8]}") for text in said)


@pytest.mark.parametrize("speaks", [True, False])
def test_another_device_fits_the_pattern_too(make_rig: MakeRig, table: Row, speaks: bool) -> None:
    """A GPS, on or off, is found before the sensor; and again after the sensor was unplugged."""
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
    if not speaks:
        table(
            "another device, a GPS, fits the sensor's pattern, and is found first",
            'STATUSTEXT "digitizer is silent", and `sensor_state` silent, until it is left for the next',
            f"{found:.2f} s after the start (`sensor.timeout` is 0.5 s); unplugged, and back: {back:.2f} s",
            "nothing; it gets the sensor's start-up commands",
        )
    assert found < 5.0
    assert back < 2.0
    replays(rig)
    os.close(gps)
    os.close(far)


def test_tcp_server_gone_and_back(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig("tcp")
    rig.start()
    rig.run(0.3)
    last, mark = rig.of("MAG_FIELD")[-1]["sequence"], rig.mark
    rig.autopilot.down()
    rig.run(1.2)
    assert rig.process is not None
    assert rig.process.poll() is None
    rig.autopilot.up()
    back = rig.until_well()
    rig.until_said("link: open", mark)
    sequences = [message["sequence"] for message in rig.of("MAG_FIELD", mark)]
    lost = next(number for number in sequences if number > last + 20) - last - 1
    assert sequences == sorted(sequences)
    table(
        "autopilot link down (TCP: the server closes), up again after 1.2 s",
        '"link: closed by the other end" in the log, then "link: open" over the link; `stale_telemetry` in '
        "between",
        f"{back:.2f} s",
        f"messages to the autopilot, visible in MAG_FIELD's `sequence` ({lost} here); the log has them all",
    )
    assert back < 2.0
    replays(rig)


def test_a_serial_line_that_is_too_slow(make_rig: MakeRig, table: Row) -> None:
    """Nobody reads the line for as long as it takes to fill what the system keeps for it."""
    rig = make_rig("serial")
    rig.start()
    mark, deadline = rig.mark, time.monotonic() + 60.0
    while not said_in(rig.logs, "link: too slow"):
        assert time.monotonic() < deadline
        for _ in range(100):
            rig.fluxgate.turn()
            time.sleep(0.005)
    back = rig.until_well()
    rig.until_said("bytes not sent so far", mark, 30.0)
    table(
        "autopilot's serial line too slow: nobody reads it",
        "whole messages are dropped, those first that a newer one replaces; "
        'STATUSTEXT "link: too slow, 1740 bytes not sent so far", again every 10 s',
        f"{back:.2f} s",
        "messages to the autopilot, visible in MAG_FIELD's `sequence`; the log has them all",
    )
    assert back < 5.0
    replays(rig)


def said_in(logs: list[Path], text: str) -> bool:
    """Say whether a bridge has said `text`, as far as its log is on the disk."""
    return any(text.encode() in path.read_bytes() for path in logs)


def test_autopilot_on_a_serial_line_pulled_out_and_back(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig("serial")
    rig.start()
    rig.until_answered()
    last, mark, away = rig.of("MAG_FIELD")[-1]["sequence"], rig.mark, time.monotonic()
    rig.autopilot.down()
    rig.run(1.0)
    rig.autopilot.up()
    back = rig.until_well()
    rig.until_said("link: open", mark)
    lost = rig.of("MAG_FIELD", mark)[0]["sequence"] - last - 1
    table(
        "autopilot on a serial line: pulled out, back after 1.0 s",
        '"link: No such file or directory" in the log, then "link: open" over the link; `stale_telemetry` '
        "in between",
        f"{back:.2f} s",
        f"messages to the autopilot, visible in MAG_FIELD's `sequence` ({lost} here); the log has them all",
    )
    assert back < 2.0
    assert 25 <= lost <= 100 + 50 * rig.machine.seconds(away, time.monotonic())
    replays(rig)


def test_host_clock_set_forward_and_back(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig(stepped=True)
    rig.start()
    mark = rig.mark
    for step in (3600.0, -7200.0):
        before = rig.of("MAG_FIELD")[-1]
        seen = rig.mark
        rig.step(step)
        noticed = rig.until_said("clock was set by", seen)
        # less than the threshold is slewing, and so may a late look at one of two clocks be off
        (reported,) = [float(text.split()[-2]) for text in rig.said(seen) if "clock was set by" in text]
        assert reported == pytest.approx(step, abs=Clock.THRESHOLD_US * 1e-6)
        rig.run(0.2)
        after = rig.of("MAG_FIELD")[-1]
        elapsed = (after["time_usec"] - before["time_usec"]) * 1e-6
        samples = (after["sequence"] - before["sequence"]) / 50
        assert elapsed == pytest.approx(step + samples, abs=0.1)
        assert noticed < 1.5
    assert rig.undue_flags(mark) == ""
    assert rig.status["samples_lost"] == 0
    (log,) = rig.logs
    with log.open("rb") as file:
        times = [record.time_us for record in LogReader(file)]
    assert times == sorted(times)
    table(
        "host clock set 1 h forward, then 2 h back",
        f"STATUSTEXT ({noticed:.2f} s after the step), and from then on the published UNIX times follow; no "
        "flag, because no interval is measured with that clock",
        "at once",
        "nothing; samples between the step and the STATUSTEXT carry the old UNIX time",
    )
    replays(rig)


def test_forged_signed_packets(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig(key=KEY)
    rig.start()
    before, mark = rig.fresh_status(), rig.mark
    genuine = rig.autopilot.telemetry()
    rig.autopilot.send(genuine)
    future = ((1 << 48) - 1).to_bytes(6, "little")
    thief = Codec(1, 1, Signing(bytes(32)))
    thief.now_us = time.time_ns() // 1000 + 10**15
    wrong = [
        genuine[:-12] + future + genuine[-6:],  # a genuine one with another time stamp
        thief.pack("NAMED_VALUE_FLOAT", value=-9.0, name="battpos"),  # signed with another key, in the future
        Codec(1, 1).pack("NAMED_VALUE_FLOAT", value=-9.0, name="battpos"),  # not signed
        genuine,  # sent again
    ]
    for frame in wrong:
        rig.autopilot.send(frame)
    rig.until_status(lambda status: status["link_refused"] == before["link_refused"] + len(wrong))
    rig.run(0.8)  # beyond max_age: only later genuine telemetry keeps the field good
    rig.until_answered()
    assert rig.undue_flags(mark) == ""
    assert all(message.frame[2] & 1 for _, message in rig.heard)
    table(
        "forged packets: a time stamp far in the future, another key, no signature, a replayed genuine "
        "packet",
        "no change; the genuine packets that follow are accepted",
        "at once",
        f"the forged packets: `link_refused` {len(wrong)}",
    )
    replays(rig)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path | None]:
    """A file system of 128 kB; None without the right to mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, check=False, capture_output=True).returncode:
        yield None
        return
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def ballast(disk: Path) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return what fills a disk, and what makes room on it again."""
    file = disk / "ballast"

    def fill() -> None:
        with suppress(OSError), file.open("wb", buffering=0) as open_file:
            while open_file.write(bytes(4096)):
                pass

    return fill, file.unlink


def limit(rig: Rig) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return what any user can do instead: limit the size of the process's files, and lift that again."""

    def allow(size: int) -> None:
        assert rig.process is not None
        resource.prlimit(rig.process.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return lambda: allow(rig.logs[-1].stat().st_size + 1000), lambda: allow(resource.RLIM_INFINITY)


def test_disk_full(make_rig: MakeRig, small_disk: Path | None, table: Row) -> None:
    rig = make_rig()
    if small_disk is not None:
        rig.config.write_text(rig.config.read_text().replace('"logs"', f'"{small_disk}"'))
        (rig.folder / "logs").symlink_to(small_disk)
    fill, make_room = ballast(small_disk) if small_disk is not None else limit(rig)
    rig.start()
    mark = rig.mark
    fill()
    rig.until_status(lambda status: status["log_state"] == LOG_FAILED)
    rig.until(lambda: any(line.startswith("log: ") for line in rig.said(mark)))
    lost = rig.until_status(lambda status: status["log_lost"] > 0)["log_lost"]
    rig.until_status(lambda status: status["log_lost"] > lost)
    make_room()
    mended = rig.until(lambda: rig.status["log_state"] == LOG_OK)
    rig.until_said("log: being written", mark)
    assert rig.undue_flags(mark) == ""
    fields = [message["sequence"] for message in rig.of("MAG_FIELD")]
    assert fields == list(range(fields[0], fields[0] + len(fields)))
    lost = rig.fresh_status()["log_lost"]
    assert rig.stop() == 0
    for path in rig.logs:
        with path.open("rb") as file:
            reader = LogReader(file)
            assert sum(1 for _ in reader) > 0, path
            assert reader.damages == 0
    recorded, published = rig.replay(rig.logs[:1])
    assert first_difference(published[: len(recorded.published)], recorded.published) is None
    said = next(line for line in rig.said(mark) if line.startswith("log: ") and "written" not in line)
    assert said == ("log: No space left on device" if small_disk is not None else "log: File too large")
    table(
        "disk full, then room again",
        f'the field goes on without a flag; STATUSTEXT "{said}", `log_state` failed',
        f"{mended:.1f} s, in a new file",
        f"the log in between: `log_lost` {lost} records; what was written before can be read to its end",
    )


def test_a_log_that_is_removed(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig()
    rig.start()
    mark = rig.mark
    set_parameter(rig)
    (gone,) = rig.logs
    gone.unlink()
    rig.until_status(lambda status: status["log_state"] == LOG_FAILED)
    mended = rig.until(lambda: rig.status["log_state"] == LOG_OK)
    rig.until_said("log: being written", mark)
    rig.run(1.0)
    assert rig.undue_flags(mark) == ""
    assert rig.stop() == 0
    (anew,) = rig.logs
    assert anew != gone
    assert read(anew).sizes["time"] > 0
    recorded, published = rig.replay([anew])
    assert recorded.late > 5.0
    assert recorded.start.parameters == {"MB_GAP_FACTOR": 3.0}
    again = agreement(bytearray(published), recorded)
    assert again["samples"] > 50
    (said,) = {line for line in rig.said(mark) if line.startswith("log: ") and "written" not in line}
    table(
        "somebody deletes the log while it is being written",
        f'the field goes on without a flag; STATUSTEXT "{said}", `log_state` failed',
        f"{mended:.1f} s, in a new file",
        f"the deleted log and the records until the new one: `log_lost` {rig.status['log_lost']} records; "
        "the new one lacks what the bridge knew when it began; its replay says so, and in how many samples "
        "the field is the same",
    )


def set_parameter(rig: Rig) -> None:
    """Set a parameter as a station would."""
    mark = rig.mark
    to = {"target_system": 1, "target_component": 191}
    rig.autopilot.say("PARAM_SET", **to, param_id="MB_GAP_FACTOR", param_value=3.0, param_type=9)
    rig.until(lambda: rig.of("PARAM_VALUE", mark))


def test_killed_without_warning(make_rig: MakeRig, table: Row) -> None:
    rig = make_rig()
    rig.start()
    set_parameter(rig)
    rig.run(1.0)
    assert rig.process is not None
    rig.process.kill()
    rig.process.wait()
    rig.run(0.1)
    (log,) = rig.logs
    recorded, published = rig.replay()
    assert recorded.damages <= 1
    assert first_difference(published[: len(recorded.published)], recorded.published) is None
    heard = [message.frame for _, message in rig.heard]
    missing = [frame for frame in heard[-200:] if frame not in recorded.published]
    assert len(missing) <= 20, "more than the last event"
    assert missing == heard[len(heard) - len(missing) :]
    with log.open("rb") as file:
        channels = {record.channel for record in LogReader(file)}
    assert channels == set(Channel)

    mark = rig.mark
    back = rig.again()
    assert len(rig.logs) == 2
    rig.autopilot.say(
        "PARAM_REQUEST_READ", target_system=1, target_component=191, param_id="MB_GAP_FACTOR", param_index=-1
    )
    rig.until(lambda: rig.of("PARAM_VALUE", mark))
    assert rig.of("PARAM_VALUE", mark)[-1]["param_value"] == 3.0
    table(
        "`kill -9`, started again",
        "nothing, then a normal start. Parameters set over the link are kept",
        f"{back:.1f} s after the start",
        f"at most the last event of the log: {len(missing)} messages here; the rest replays to the same "
        "bytes",
    )


def test_two_bridges_in_one_folder(make_rig: MakeRig) -> None:
    """Each keeps its own parameters, and the files of its log stand together."""
    rig = make_rig(more="max_size = 0.02\n")
    rig.start()
    set_parameter(rig)
    other = rig.folder / "other.toml"
    other.write_text(
        rig.config.read_text().replace("ttyUSB*", "ttyNone").replace(rig.url, "udpout:127.0.0.1:9")
    )
    second = rig.spawn(other)
    begun = len(rig.logs)
    rig.until(lambda: len(rig.logs) >= begun + 4 and sum(map(is_own_log, rig.logs)) == 2)
    rig.run(1.0)
    assert rig.stop() == 0
    second.terminate()
    assert second.wait(10) == 0
    assert {path.name for path in rig.folder.glob("*.json")} == {"cal.json", "bridge.parameters.json"}
    for files, kept in zip(runs(rig.logs), ({"MB_GAP_FACTOR": 3.0}, {}), strict=True):
        recorded, published = rig.replay(files)
        assert recorded.damages == 0
        assert rig.of("PARAM_VALUE")[-1].frame in recorded.published or not kept
        assert first_difference(published, recorded.published) is None


def test_stopped_by_hand_with_a_log_in_many_files(make_rig: MakeRig) -> None:
    rig = make_rig("udpin", more="max_size = 0.02\n")
    rig.start()
    rig.until(lambda: len(rig.logs) >= 3)
    assert rig.process is not None
    begun = time.monotonic()
    os.kill(rig.process.pid, signal.SIGINT)
    assert rig.process.wait(5) == 0
    assert rig.since(begun) < 2.0
    assert all(path.stat().st_size <= 20_000 for path in rig.logs)
    recorded, published = rig.replay()
    assert recorded.damages == 0
    assert first_difference(published, recorded.published) is None
