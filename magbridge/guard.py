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

SECONDS, PER_MEGABYTE = 8.0, 0.2
"""Processor time for a file, s, and for each MB of it: any format needs a tenth of that."""
MEMORY, PER_BYTE = 500_000_000, 50
"""Bytes of memory for a file, and for each byte of it: compressed, a log may be thirty times smaller."""
RESERVED_BYTES = 8_000_000_000
"""Bytes of address space beyond that: dbdreader asks for a GB, and uses little of it."""
POLL = 0.1
"""Time between two checks of a child's memory, s."""
TOO_LARGE = "asks for far more memory than its size allows: damaged"
WAIT = 10.0
"""Wall-clock over processor time after which a child counts as stuck: disks and other processes are slow."""


class Raised(NamedTuple):
    """An error that the child sends to the parent: the function that builds it, and its arguments."""

    rebuild: Callable[..., BaseException]
    arguments: tuple[Any, ...]

    @classmethod
    def from_exception(cls, error: BaseException) -> Raised:
        """Return an error without its causes, which other packages would pickle with it."""
        how = error.__reduce__()
        assert isinstance(how, tuple)
        return cls(*how[:2])


class GuardedJob(NamedTuple):
    """A file, and the function that returns an iterable of picklable objects read from it."""

    path: Path
    read: Callable[[], Iterable[Any]]

    @property
    def limits(self) -> tuple[int, int]:
        """The s of processor time and the bytes of memory that reading it may take, by its size."""
        files = self.path.iterdir() if self.path.is_dir() else [self.path]  # a folder is one log, too
        size = sum(file.stat().st_size for file in files if file.is_file())
        return round(SECONDS + PER_MEGABYTE * size / 1e6), MEMORY + PER_BYTE * size


def guarded(path: Path, read: Callable[[], Iterable[T]]) -> Iterator[T]:
    """Yield what ``read()`` yields, run in a child process with limits on time and memory.

    The objects must be picklable; the size of the file `path` sets the limits. Without fork (Windows), and
    in a process that may not have children (a worker of a pool), this process reads the file without limits.

    FormatError: the file makes its reader fail in an unexpected way, crash, need more than 8 s of processor
    time and 0.2 s a MB, or more than 500 MB of memory and 50 times its size. MagbridgeError, OSError: as
    `read` raises them.
    """
    one = Guarded([GuardedJob(path, read)])
    try:
        yield from one.pieces(0)
    finally:
        one.close()


class Guarded:
    """Read several small files in one child process, as :func:`guarded` reads one.

    If a file ends the child, another child reads the files after it.
    """

    def __init__(self, jobs: Sequence[GuardedJob]) -> None:
        self._jobs = jobs
        self._received: list[deque[tuple[bool, Any]]] = [deque() for _ in jobs]
        self._at = 0
        self._child: _Child | None = None

    def pieces(self, k: int) -> Iterator[Any]:
        """Yield the pieces of a file, once; the pieces of files before it are kept."""
        import multiprocessing  # noqa: PLC0415 - every command imports this module, few need a child

        if sys.platform == "win32" or multiprocessing.current_process().daemon:
            yield from _foreseen(*self._jobs[k])
            return
        while True:
            while not self._received[k]:
                self._receive()
            done, piece = self._received[k].popleft()
            if isinstance(piece, Raised):
                raise piece.rebuild(*piece.arguments)
            if done:
                return
            yield piece

    def close(self) -> None:
        """End the child."""
        if self._child is not None:
            self._child.end()
            self._child = None

    def _receive(self) -> None:
        """Wait for the next piece of the file that is being read."""
        job = self._jobs[self._at]
        if self._child is None:
            self._child = _Child(self._jobs[self._at :])
        try:
            done, piece = self._child.receive(job)
        except FormatError as error:
            self.close()
            done, piece = True, Raised.from_exception(error)
        self._received[self._at].append((done, piece))
        self._at += done
        if self._at == len(self._jobs):
            self.close()


class _Child:
    """A process that reads files, and the pipe through which the pieces come."""

    def __init__(self, jobs: Sequence[GuardedJob]) -> None:
        import multiprocessing  # noqa: PLC0415 - every command imports this module, few need a child

        context = multiprocessing.get_context("fork")
        self._used = _memory()[1]
        self._pieces, end = context.Pipe(duplex=False)
        self._process = context.Process(target=_send, args=(end, jobs), daemon=True)
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # of a fork with other threads: the child uses none
            self._process.start()
        end.close()
        self.end = weakref.finalize(self, _end, os.getpid(), self._process, self._pieces)

    def receive(self, job: GuardedJob) -> tuple[bool, Any]:
        """Return whether `job` is done, and its piece; FormatError: it takes too much, or ends the child."""
        (seconds, memory), waited = job.limits, 0.0
        while not self._pieces.poll(POLL):
            waited += POLL
            if waited > WAIT * seconds:
                raise FormatError(job.path, f"takes longer than {WAIT * seconds:.0f} s to read: damaged")
            if _memory(self._process.pid)[1] > self._used + memory:
                raise FormatError(job.path, TOO_LARGE)
        try:
            done, piece = self._pieces.recv()
        except EOFError:
            self._process.join()
            raise FormatError(job.path, _ended_by(self._process.exitcode or 0, seconds)) from None
        return bool(done), piece


def _end(parent: int, process: BaseProcess, pieces: Connection) -> None:
    """End the child, in the process that started it: `parent` is its number."""
    if os.getpid() != parent:  # a copy of the object in a process that was forked since
        return
    process.kill()
    process.join()
    pieces.close()


def _foreseen(path: Path, read: Callable[[], Iterable[T]]) -> Iterator[T]:
    """Yield what ``read()`` yields; any unexpected exception becomes a FormatError."""
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
        # whatever a library raises on bytes that it was not made for; the traceback goes with the error
        first = next(iter(str(error).splitlines()), "")
        damaged = FormatError(path, f"cannot be read, damaged? {type(error).__name__}: {first}"[:300])
        damaged.add_note(traceback.format_exc())
        raise damaged from error


def _send(end: Connection, jobs: Sequence[GuardedJob]) -> None:
    """Read in the child, and send (False, piece) for each of a file, then (True, None) or (True, Raised)."""
    faulthandler.disable()
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # HDF5 and dbdreader print what they find
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
                end.send((True, Raised.from_exception(error)))
    except BrokenPipeError:  # the parent wants no more
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
    """Return the fault of a file whose child ended with this exit code."""
    if code == -signal.SIGXCPU:
        return f"takes longer than {seconds} s of processor time to read: damaged"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"damaged: it crashes the library that reads it ({name})"
