"""Test faults of the log and abrupt ends: full disk, deleted folder, kill -9, several bridges or files."""

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
from checks import Measured, first_difference, records
from rig import Rig

from magbridge.logs import read
from magbridge.mavlink import LogReader
from magbridge.records import Channel
from sitl.replay.run import agreement

MakeRig = Callable[..., Rig]
LOG_OK, LOG_FAILED = 1, 2


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path | None]:
    """Return the folder of a file system of 128 kB, or None if the user may not mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, check=False, capture_output=True).returncode:
        yield None
        return
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def ballast(disk: Path) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return a function that fills a disk, and one that frees space on it."""
    file = disk / "ballast"

    def fill() -> None:
        with suppress(OSError), file.open("wb", buffering=0) as open_file:
            while open_file.write(bytes(4096)):
                pass

    return fill, file.unlink


def limit(rig: Rig) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return functions that limit the size of the process's files, and that remove this limit."""

    def allow(size: int) -> None:
        assert rig.process is not None
        resource.prlimit(rig.process.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return lambda: allow(rig.logs[-1].stat().st_size + 1000), lambda: allow(resource.RLIM_INFINITY)


def test_disk_full(make_rig: MakeRig, small_disk: Path | None, measured: Measured) -> None:
    rig = make_rig()
    if small_disk is not None:
        rig.config.write_text(rig.config.read_text().replace('"logs"', f'"{small_disk}"'))
        (rig.folder / "logs").symlink_to(small_disk)
    fill, make_room = ballast(small_disk) if small_disk is not None else limit(rig)
    rig.start()
    mark = rig.mark
    fill()
    rig.until_status(lambda status: status["log_state"] == LOG_FAILED)
    rig.until(lambda: any(line.startswith("log: ") for line in rig.texts(mark)))
    lost = rig.until_status(lambda status: status["log_lost"] > 0)["log_lost"]
    rig.until_status(lambda status: status["log_lost"] > lost)
    make_room()
    mended = rig.until(lambda: rig.status["log_state"] == LOG_OK)
    rig.until_reported("log: being written", mark)
    assert rig.undue_flags(mark) == ""
    fields = [message["sequence"] for message in rig.of("MAG_FIELD")]
    assert fields == list(range(fields[0], fields[0] + len(fields)))
    lost = rig.fresh_status()["log_lost"]
    assert rig.stop() == 0
    for path in rig.logs:
        assert records(path)
    recorded, published = rig.replay(rig.logs[:1])
    assert first_difference(published[: len(recorded.published)], recorded.published) is None
    texts = next(line for line in rig.texts(mark) if line.startswith("log: ") and "written" not in line)
    assert texts == ("log: No space left on device" if small_disk is not None else "log: File too large")
    measured(recovers_s=mended, records_lost=lost)


def test_a_log_that_is_removed(make_rig: MakeRig, measured: Measured) -> None:
    rig = make_rig()
    rig.start()
    mark = rig.mark
    rig.set_parameter("MB_GAP_FACTOR", 3.0)
    rig.until(lambda: rig.of("PARAM_VALUE"))
    (gone,) = rig.logs
    gone.unlink()
    rig.until_status(lambda status: status["log_state"] == LOG_FAILED)
    mended = rig.until(lambda: rig.status["log_state"] == LOG_OK)
    rig.until_reported("log: being written", mark)
    rig.run(1.0)
    assert rig.undue_flags(mark) == ""
    assert rig.stop() == 0
    (anew,) = rig.logs
    assert anew != gone
    assert read(anew).sizes["time"] > 0
    recorded, published = rig.replay([anew])
    assert recorded.late > 5.0
    assert recorded.start.parameters == {"MB_GAP_FACTOR": 3.0}
    restart = agreement(bytearray(published), recorded)
    assert restart["samples"] > 50
    assert len({line for line in rig.texts(mark) if line.startswith("log: ") and "written" not in line}) == 1
    measured(recovers_s=mended, records_lost=rig.status["log_lost"])


def test_killed_without_warning(make_rig: MakeRig, measured: Measured) -> None:
    rig = make_rig()
    rig.start()
    rig.set_parameter("MB_GAP_FACTOR", 3.0)
    rig.until(lambda: rig.of("PARAM_VALUE"))
    rig.run(1.0)
    assert rig.process is not None
    rig.process.kill()
    rig.process.wait()
    rig.run(0.1)
    (log,) = rig.logs
    recorded, published = rig.replay()
    assert recorded.damages <= 1
    assert first_difference(published[: len(recorded.published)], recorded.published) is None
    received = [message.frame for _, message in rig.received]
    missing = [frame for frame in received[-200:] if frame not in recorded.published]
    assert len(missing) <= 20, "more than the last 50 ms"
    assert missing == received[len(received) - len(missing) :]
    with log.open("rb") as file:
        channels = {record.channel for record in LogReader(file)}
    assert channels == set(Channel)

    mark = rig.mark
    back = rig.restart()
    assert len(rig.logs) == 2
    rig.autopilot.send_message(
        "PARAM_REQUEST_READ", target_system=1, target_component=191, param_id="MB_GAP_FACTOR", param_index=-1
    )
    rig.until(lambda: rig.of("PARAM_VALUE", mark))
    assert rig.of("PARAM_VALUE", mark)[-1]["param_value"] == 3.0
    measured(recovers_s=back, messages_lost=len(missing))


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
