"""Read files that may be damaged in a child process with limits on time and memory.

On a damaged file, a library may loop forever, allocate all memory or crash. In a child process, each of these
becomes an error that names the file. The pieces of the file come back through a pipe, which costs one fork
and one copy.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import traceback
import warnings
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from magbridge.errors import FormatError, MagbridgeError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

if sys.platform != "win32":
    import resource

__all__ = ["Guarded", "GuardedJob", "guarded"]

T = TypeVar("T")

BASE_TIME_S, TIME_S_PER_MB = 8.0, 0.2
"""Allowed processor time for a file: a constant, and an amount for each MB. Each format needs a tenth."""
BASE_MEMORY_BYTES, MEMORY_PER_FILE_BYTE = 500_000_000, 50
"""Allowed memory for a file: a constant, and a multiple of its size, because logs may be compressed."""
RESERVED_BYTES = 8_000_000_000
"""Address space allowed in addition, because dbdreader reserves 1 GB and uses little of it."""
MEMORY_POLL_S = 0.1
"""Time between two checks of a child's memory, s."""
TOO_LARGE = "asks for far more memory than its size allows: damaged"
MAX_WAIT_RATIO = 10.0
"""Allowed ratio of elapsed time to allowed processor time; the disk and other processes may be slow."""


class GuardedJob(NamedTuple):
    """File to read, and a function that reads it and returns an iterable of picklable objects."""

    path: Path
    read: Callable[[], Iterable[Any]]

    @property
    def limits(self) -> tuple[int, int]:
        """Allowed processor time (s) and memory (bytes), computed from the size of the file."""
        files = self.path.iterdir() if self.path.is_dir() else [self.path]  # a folder holds one log
        size = sum(file.stat().st_size for file in files if file.is_file())
        memory = BASE_MEMORY_BYTES + MEMORY_PER_FILE_BYTE * size
        return round(BASE_TIME_S + TIME_S_PER_MB * size / 1e6), memory


def guarded(path: Path, read: Callable[[], Iterable[T]]) -> Iterator[T]:
    """Run ``read()`` in a child process with limits on time and memory, and yield the objects it yields.

    The objects must be picklable. The limits follow from the size of the file `path`. On Windows, and in a
    process that cannot start child processes (a worker of a pool), the file is read in this process without
    limits.

    FormatError: the reader crashes, raises an unexpected exception, or exceeds the limit on processor time
    (8 s plus 0.2 s per MB) or on memory (500 MB plus 50 times the size). MagbridgeError, OSError: `read`
    raises it.
    """
    reader = Guarded([GuardedJob(path, read)])
    try:
        yield from reader.pieces(0)
    finally:
        reader.close()


class Guarded:
    """Reader of several small files in one child process; limits and errors are those of :func:`guarded`.

    If reading a file ends the child process, a new child process reads the remaining files.
    """

    def __init__(self, jobs: Sequence[GuardedJob]) -> None:
        self._jobs = jobs
        self._received: list[deque[tuple[bool, Any]]] = [deque() for _ in jobs]
        self._current = 0
        self._child: _Child | None = None

    def pieces(self, k: int) -> Iterator[Any]:
        """Yield the objects read from file `k`; objects of earlier files remain available."""
        import multiprocessing  # noqa: PLC0415 - every command imports this module, few need a child

        if sys.platform == "win32" or multiprocessing.current_process().daemon:
            yield from _foreseen(*self._jobs[k])
            return
        while True:
            while not self._received[k]:
                self._receive()
            done, piece = self._received[k].popleft()
            if not done:
                yield piece
            elif piece is None:
                return
            else:
                rebuild, arguments = piece
                raise rebuild(*arguments)

    def close(self) -> None:
        """End the child process."""
        if self._child is not None:
            self._child.end()
            self._child = None

    def _receive(self) -> None:
        """Wait for the next object, or the end, of the file that the child process is reading."""
        job = self._jobs[self._current]
        if self._child is None:
            self._child = _Child(self._jobs[self._current :])
        try:
            done, piece = self._child.receive(job)
        except FormatError as error:
            self.close()
            done, piece = True, error.__reduce__()[:2]
        self._received[self._current].append((done, piece))
        self._current += done
        if self._current == len(self._jobs):
            self.close()


class _Child:
    """Child process that reads files, and the pipe from which the parent receives the objects."""

    def __init__(self, jobs: Sequence[GuardedJob]) -> None:
        import multiprocessing  # noqa: PLC0415 - every command imports this module, few need a child

        context = multiprocessing.get_context("fork")
        self._used = _memory()[1]
        self._pieces, end = context.Pipe(duplex=False)
        self._process = context.Process(target=_send, args=(end, jobs), daemon=True)
        with warnings.catch_warnings():
            # Python warns of a fork while other threads run; the child does not use these threads
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        end.close()
        self.end = weakref.finalize(self, _end, os.getpid(), self._process, self._pieces)

    def receive(self, job: GuardedJob) -> tuple[bool, Any]:
        """Return (True at the end of `job`, object); FormatError: `job` exceeds a limit or ends the child."""
        (seconds, memory), waited = job.limits, 0.0
        while not self._pieces.poll(MEMORY_POLL_S):
            waited += MEMORY_POLL_S
            if waited > MAX_WAIT_RATIO * seconds:
                most_s = MAX_WAIT_RATIO * seconds
                raise FormatError(job.path, f"takes longer than {most_s:.0f} s to read: damaged")
            if _memory(self._process.pid)[1] > self._used + memory:
                raise FormatError(job.path, TOO_LARGE)
        try:
            done, piece = self._pieces.recv()
        except EOFError:
            self._process.join()
            raise FormatError(job.path, _ended_by(self._process.exitcode or 0, seconds)) from None
        return bool(done), piece


def _end(parent: int, process: BaseProcess, pieces: Connection) -> None:
    """End the child process, if this process is the one that started it (process id `parent`)."""
    if os.getpid() != parent:  # this process was forked later and holds a copy
        return
    process.kill()
    process.join()
    pieces.close()


def _foreseen(path: Path, read: Callable[[], Iterable[T]]) -> Iterator[T]:
    """Yield the objects of ``read()``; raise a FormatError in place of an unexpected exception."""
    try:
        yield from read()
    except (MagbridgeError, OSError):
        raise
    except MemoryError as error:
        raise FormatError(path, TOO_LARGE) from error
    except UnicodeEncodeError as error:
        if path.name not in error.object:
            raise FormatError(path, f"cannot be read, damaged? {error}"[:300]) from error
        raise FormatError(path, f"expected a name in {error.encoding}; rename the file") from error
    except Exception as error:
        # a library may raise any exception on damaged bytes; the note keeps its traceback
        first = next(iter(str(error).splitlines()), "")
        damaged = FormatError(path, f"cannot be read, damaged? {type(error).__name__}: {first}"[:300])
        damaged.add_note(traceback.format_exc())
        raise damaged from error


def _send(end: Connection, jobs: Sequence[GuardedJob]) -> None:
    """Read files in the child; send (False, object) for each, then (True, None or an error's parts)."""
    faulthandler.disable()
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # HDF5 and dbdreader print messages
        os.dup2(silent, stream)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the child
    for number in (signal.SIGTERM, signal.SIGXCPU):
        signal.signal(number, signal.SIG_DFL)
    try:
        for job in jobs:
            _limit(*job.limits)
            try:
                for piece in _foreseen(*job):
                    end.send((False, piece))
                end.send((True, None))
            except BrokenPipeError:
                raise
            except (MagbridgeError, OSError) as error:
                end.send((True, error.__reduce__()[:2]))  # its causes may not be picklable
    except BrokenPipeError:  # the parent has stopped reading
        pass


def _limit(seconds: int, memory: int) -> None:
    """Limit this process to `seconds` of processor time and `memory` bytes beyond its present use."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _set(resource.RLIMIT_CPU, round(used.ru_utime + used.ru_stime) + seconds)
    if size := _memory()[0]:
        _set(resource.RLIMIT_AS, size + memory + RESERVED_BYTES)


def _memory(process: int | str | None = "self") -> tuple[int, int]:
    """Return the bytes of address space and of memory of a process; 0 if the system does not report it."""
    try:
        size, resident = Path(f"/proc/{process}/statm").read_text().split()[:2]
    except OSError:
        return 0, 0
    return int(size) * resource.getpagesize(), int(resident) * resource.getpagesize()


def _set(kind: int, limit: int) -> None:
    _, most = resource.getrlimit(kind)
    resource.setrlimit(kind, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def _ended_by(code: int, seconds: int) -> str:
    """Return the message about a file whose child process ended with exit code `code`."""
    if code == -signal.SIGXCPU:
        return f"takes longer than {seconds} s of processor time to read: damaged"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"damaged: it crashes the library that reads it ({name})"
