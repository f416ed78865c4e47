"""Test the writing of tlogs: rotation, full and stalled disks, loss of power."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest
from machine import standstill

from magbridge.logs import tlog
from magbridge.logs.tlog import TlogWriter
from magbridge.records import Channel

T0 = 1_700_000_000_000_000  # µs, a multiple of 4
FRAME = b"\xfd" + bytes(range(40))


def records(path: Path) -> list[tuple[int, bytes]]:
    data, size = path.read_bytes(), 8 + len(FRAME)
    whole = [data[k : k + size] for k in range(0, len(data), size)]
    return [(int.from_bytes(one[:8], "big"), one[8:]) for one in whole]


def wait(condition: Callable[[], object]) -> None:
    """Wait until the writing thread has made a condition true, at most 5 s."""
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_records_carry_time_and_channel(tmp_path: Path) -> None:
    with closing(TlogWriter(tmp_path / "new" / "logs")) as log:
        for k, channel in enumerate(Channel):
            log.extend([(T0 + 4 * k, channel, FRAME)])
    (path,) = (tmp_path / "new" / "logs").iterdir()
    assert path.name == "20231114T221320Z_0001.tlog"
    assert records(path) == [(T0 + 4 * k | channel, FRAME) for k, channel in enumerate(Channel)]
    assert (log.records, log.lost, log.failure) == (4, 0, "")


def test_first_record_after_a_pause_is_on_disk_at_once(tmp_path: Path) -> None:
    with closing(TlogWriter(tmp_path)) as log:
        for k in range(3):
            log.extend([(T0 + 4 * k, 0, FRAME)])
            wait(lambda: log.records > k)  # noqa: B023
            time.sleep(2 * tlog.WRITE_INTERVAL_S)
        (path,) = tmp_path.iterdir()
        assert len(records(path)) == 3


def test_two_runs_in_one_folder_keep_apart(tmp_path: Path) -> None:
    """The names of the two runs differ, so that each can be replayed although both began in one second."""
    frames = FRAME, FRAME[::-1]
    one, other = (TlogWriter(tmp_path, max_size=1e-3) for _ in frames)
    with closing(one), closing(other):
        for k in range(60):
            for log, frame in zip((one, other), frames, strict=True):
                log.extend([(T0 + 4_000_000 * k, 0, frame)])
                wait(lambda: log.records > k)  # noqa: B023
    files = sorted(tmp_path.iterdir())
    assert [path.name[13:] for path in files] == [f"{s}Z_000{k}.tlog" for s in (20, 21) for k in (1, 2, 3)]
    assert [frame for path in files for _, frame in records(path)] == [frames[0]] * 60 + [frames[1]] * 60


def test_new_file_by_size_and_by_age_loses_nothing(tmp_path: Path) -> None:
    step = 4_000_000
    with closing(TlogWriter(tmp_path, max_size=1e-3, max_age=0.01)) as log:  # 20 records, 36 s
        for k in range(100):
            log.extend([(T0 + step * k, 0, FRAME)])
    files = sorted(tmp_path.iterdir())
    assert [record for path in files for record in records(path)] == [
        (T0 + step * k, FRAME) for k in range(100)
    ]
    assert all(path.stat().st_size <= 1000 for path in files)
    assert all(records(path)[-1][0] - records(path)[0][0] <= 36_000_000 for path in files)
    assert len({path.name.rpartition("_")[2] for path in files}) == len(files)


def test_directory_that_cannot_be_made_is_reported_and_tried_again(tmp_path: Path) -> None:
    """An example is a disk that is mounted some seconds after the start of the bridge."""
    directory = tmp_path / "disk" / "logs"
    directory.parent.write_text("")
    with closing(TlogWriter(directory)) as log:
        log.extend([(T0, 0, FRAME)])
        wait(lambda: log.failure)
        assert (log.lost, log.failure) == (1, "Not a directory")
        directory.parent.unlink()
        log.extend([(T0 + tlog.LOG_RETRY_US, 0, FRAME)])
    assert (log.records, log.failure) == (1, "")


def test_full_disk_stops_the_log_and_not_the_caller(tmp_path: Path) -> None:
    """A file size limit is what a process can do to itself; the write fails half-way, as on a full disk."""
    script = f"""
import resource, signal, sys, time
from magbridge.logs import tlog
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
log = tlog.TlogWriter({str(tmp_path)!r})
frame, k = bytes({FRAME!r}), 0
def put(n, step):
    global k
    for _ in range(n):
        log.extend([({T0} + step * k, 0, frame)])
        k += 1
        time.sleep(0.0005)
    while log.records + log.lost < k:
        time.sleep(0.001)
put(100, 4)
assert log.failure == 'File too large', log.failure
full = log.records, log.lost
assert sum(full) == 100 and 0 < full[0] <= 1000 // 49, full
put(10, 4)
assert log.records == full[0] and log.lost == full[1] + 10
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
put(10, 100_000)  # 11 s later, as the stamps tell
assert log.failure == '', log.failure
assert log.records == full[0] + 10, (log.records, full)
log.close()
print(full[0])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first, second = sorted(tmp_path.iterdir())
    assert len(records(first)) == int(done.stdout)  # whole records only
    assert len(records(second)) == 10


@pytest.mark.parametrize("removed", ["file", "folder"])
def test_a_log_that_is_removed_is_missed(tmp_path: Path, removed: str) -> None:
    """A removed log can still be written as an open file, but its name no longer exists."""

    def write(time_us: int) -> tuple[int, int, str]:
        before = log.records + log.lost
        log.extend([(time_us, Channel.SENT, FRAME)])
        wait(lambda: log.records + log.lost > before)
        return log.records, log.lost, log.failure

    folder = tmp_path / "logs"
    with closing(TlogWriter(folder)) as log:
        assert write(T0) == (1, 0, "")
        (path,) = folder.iterdir()
        path.unlink()
        if removed == "folder":
            folder.rmdir()
        assert write(T0 + tlog.SYNC_US) == (1, 1, "No such file or directory")
        assert write(T0 + tlog.SYNC_US + tlog.LOG_RETRY_US) == (2, 1, "")
    assert [path.name[-9:] for path in folder.iterdir()] == ["0002.tlog"]


def test_a_file_after_a_loss_begins_with_the_beginning_and_one_in_turn_does_not(tmp_path: Path) -> None:
    header, begin = bytes([0xFD]) * len(FRAME), bytes([0xFE]) * len(FRAME)
    folder, aside = tmp_path / "logs", tmp_path / "aside"
    with closing(TlogWriter(folder, header=[header], beginning=[begin], max_age=1e-3)) as log:
        for k in (0, 1, 2):
            log.extend([(T0 + k * 4_000_000, 0, FRAME)])
        wait(lambda: log.records == 3)
        folder.rename(aside)
        folder.write_text("no folder")
        log.extend([(T0 + 12_000_000, 0, FRAME)])
        wait(lambda: log.failure)
        folder.unlink()
        aside.rename(folder)
        for k in (4, 5):
            log.extend([(T0 + k * 4_000_000, 0, FRAME)])
    written = [[frame for _, frame in records(path)] for path in sorted(folder.iterdir())]
    assert written == [[FRAME, header]] * 3 + [[begin, header, FRAME], [FRAME, header]]


def test_stalled_disk_drops_and_counts_and_never_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is a pipe without a reader: its writes block like those to a disk that hangs."""
    inlet, outlet = os.pipe()
    monkeypatch.setattr(tlog, "QUEUE", 3_000)
    monkeypatch.setattr(os, "open", lambda *_: outlet)
    log = TlogWriter(tmp_path)
    log.extend([(T0, 0, FRAME)])
    time.sleep(0.1)
    monkeypatch.undo()
    monkeypatch.setattr(tlog, "QUEUE", 3_000)
    slowest, machine = 0.0, standstill()
    for k in range(20_000):
        begin = time.monotonic()
        log.extend([(T0 + 4 * k, 0, FRAME)])
        if (took := time.monotonic() - begin) > slowest:
            slowest = max(slowest, took - machine.seconds(begin, begin + took))
        if k % 1000 == 0:
            time.sleep(0.005)
    assert log.lost > 10_000
    assert slowest < 0.1
    os.set_blocking(inlet, False)
    while log._thread.is_alive():
        log.close(timeout=0.01)
        with suppress(BlockingIOError):
            os.read(inlet, 1 << 20)
    os.close(inlet)


def test_kill_9_costs_no_more_than_the_last_group(tmp_path: Path) -> None:
    script = f"""
import sys, time
from magbridge.logs.tlog import TlogWriter
log = TlogWriter({str(tmp_path)!r})
for k in range(100_000):
    log.extend([({T0} + 4 * k, 0, bytes({FRAME!r}))])
    print(k, flush=True)
    time.sleep(0.001)
"""
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    seen = [(int(child.stdout.readline()), time.monotonic()) for _ in range(400)]
    killed = time.monotonic()
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    (path,) = tmp_path.iterdir()
    logged = records(path)
    assert logged == [(T0 + 4 * k, FRAME) for k in range(len(logged))]
    due = sum(when < killed - 0.5 for _, when in seen)  # 10 intervals: a loaded machine is slow to wake
    assert len(logged) >= max(due, 1)
