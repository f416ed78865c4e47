"""Test that a reader that hangs, crashes or exhausts the memory ends in one line."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from magbridge import guard
from magbridge.errors import FormatError, WriteError
from magbridge.guard import Guarded, GuardedJob, guarded


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "log.x"
    path.write_bytes(bytes(1000))
    return path


def hangs() -> Iterator[int]:
    yield 1
    while True:
        pass


def crashes() -> Iterator[int]:
    yield 1
    os.kill(os.getpid(), signal.SIGSEGV)


def hoards() -> Iterator[int]:
    yield 1
    yield len(bytearray(10**11))


def swells() -> Iterator[int]:
    yield 1
    whole = [b"x" * 10**8 for _ in range(20)]
    yield len(whole)


def stumbles() -> Iterator[int]:
    yield 1
    yield int("no number\nat all")


def test_what_is_read_comes_back_in_pieces(file: Path) -> None:
    pieces = list(guarded(file, lambda: (np.full(3, k) for k in range(4))))
    np.testing.assert_array_equal(pieces, [[k] * 3 for k in range(4)])


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (hangs, "takes longer than 1 s of processor time to read: damaged"),
        (crashes, r"damaged: it crashes the library that reads it \(SIGSEGV\)"),
        (hoards, "asks for far more memory than its size allows: damaged"),
        (swells, "asks for far more memory than its size allows: damaged"),
        (stumbles, r"cannot be read, damaged\? ValueError: invalid literal"),
    ],
)
def test_one_line_whatever_happens(
    file: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[], Iterator[int]], words: str
) -> None:
    if read is hangs:  # to fill the memory may itself take a second on a loaded computer
        monkeypatch.setattr(guard, "BASE_TIME_S", 1.0)
    pieces = guarded(file, read)
    assert next(pieces) == 1
    with pytest.raises(FormatError, match=words) as caught:
        next(pieces)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "error",
    [
        FormatError("a.nc", "expected a number", row=3, column="x"),
        WriteError("a.nc", "No space left on device"),
        OSError(5, "Input/output error", "a.nc"),
    ],
)
def test_an_error_comes_back_with_its_values(file: Path, error: Exception) -> None:
    def fails() -> Iterator[int]:
        yield 1
        raise error

    with pytest.raises(type(error)) as caught:
        list(guarded(file, fails))
    assert str(caught.value) == str(error)
    assert vars(caught.value) == vars(error)


def test_who_reads_no_further_leaves_no_process(file: Path) -> None:
    def endless() -> Iterator[int]:
        while True:
            yield os.getpid()

    pieces = guarded(file, endless)
    child = next(pieces)
    assert child != os.getpid()
    pieces.close()  # type: ignore[attr-defined]  # it is a generator
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_a_child_that_waits_for_ever_is_ended(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "BASE_TIME_S", 1.0)
    monkeypatch.setattr(guard, "MAX_WAIT_RATIO", 0.2)

    def sleeps() -> Iterator[int]:
        time.sleep(60.0)
        yield 1

    with pytest.raises(FormatError, match="takes longer than"):
        list(guarded(file, sleeps))


def where() -> Iterator[int]:
    yield os.getpid()
    yield os.getpid()


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 0, 1, 2, 3)])
def test_one_child_reads_several_files_and_another_after_a_crash(file: Path, order: tuple[int, ...]) -> None:
    child = Guarded([GuardedJob(file, read) for read in (where, where, crashes, where, stumbles)])
    found: dict[int, list[int]] = {}
    failed: dict[int, str] = {}
    for k in order:
        found[k] = []
        try:
            for piece in child.pieces(k):
                found[k].append(piece)
        except FormatError as error:
            failed[k] = str(error)
    assert failed.keys() == {2, 4}
    assert "SIGSEGV" in failed[2]
    assert "ValueError" in failed[4]
    assert len({*found[0], *found[1]}) == 1
    assert os.getpid() not in found[0]
    assert len(set(found[3])) == 1
    assert found[3][0] != found[0][0]
    assert found[2] == found[4] == [1]


def test_each_of_several_files_has_its_own_time(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "BASE_TIME_S", 2.0)

    def busy() -> Iterator[int]:
        until = time.process_time() + 0.7
        while time.process_time() < until:
            pass
        yield 1

    child = Guarded([GuardedJob(file, busy)] * 4)
    assert [list(child.pieces(k)) for k in range(4)] == [[1]] * 4


def test_a_process_that_is_forked_while_a_file_is_read_does_not_end_the_child(file: Path) -> None:
    def read() -> Iterator[int]:
        yield 1
        yield 2

    pieces = guarded(file, read)
    assert next(pieces) == 1
    if (pid := os.fork()) == 0:  # the copy in this process is dropped without an exception and without a kill
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.unraisablehook", lambda _: os._exit(1))
            del pieces
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
    assert list(pieces) == [2]
