"""Write files and folders completely or not at all."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import file_digest, sha256
from pathlib import Path

from magbridge.errors import FormatError, MagbridgeError, WriteError

__all__ = ["atomic_path", "contents", "digest", "existing", "new_folder", "systems_reason"]

PROBE_BYTES = 1 << 20
"""Number of bytes written to find the reason of a failed write; more than a library writes at once."""


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path next to `path` to write to; rename it onto `path` when the block succeeds.

    The file is synced to the disk before it is renamed. When the block raises, the partial file is removed
    and `path` is unchanged. The partial file of a process that was killed is removed at the next write. The
    suffix is kept, because some writers choose the format by it.

    WriteError: the operating system does not let the file be written: no folder, no permission, a full disk.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    with suppress(OSError):  # the write itself reports a missing folder
        _clear(target)
    try:
        yield temporary
        _sync(temporary)
        temporary.replace(target)
        _sync(target.parent)
    except MagbridgeError:
        raise
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)  # not in the library's words
        raise WriteError(target, reason) from error
    finally:
        with suppress(OSError):  # it was renamed, or never created
            temporary.unlink()


def _sync(path: Path) -> None:
    """Sync a file or a folder to the disk, so that a power failure leaves no empty file."""
    if os.name == "nt" and path.is_dir():  # Windows syncs no folders
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # the file system has no fsync
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def existing(path: Path) -> Path:
    """Return `path` if it is a regular file; FormatError: it is not."""
    if path.is_dir():
        raise FormatError(path, "expected a file, not a directory")
    if not path.is_file():
        what = "not a pipe or a device" if path.exists() else "there is none"
        raise FormatError(path, f"expected a file, {what}")
    return path


def contents(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of a file; FormatError: there is none, or the system does not let it be read."""
    file = Path(path)
    try:
        return existing(file).read_bytes()
    except OSError as error:
        raise FormatError(file, f"cannot be read: {error.strerror or error}") from error


def digest(path: Path) -> str:
    """Return the SHA-256 of a file or folder; a calibration stores those of its inputs."""
    if path.is_dir():  # a bag: one log in several files
        parts = [digest(file) for file in sorted(path.iterdir()) if file.is_file()]
        return sha256("".join(parts).encode()).hexdigest()
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


@contextmanager
def new_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Create a folder if it does not exist, and yield it.

    If the block raises, the created folders are removed with their contents; a folder that existed before
    remains.
    """
    folder = Path(path)
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except BaseException:
        if missing:
            shutil.rmtree(missing[-1], ignore_errors=True)
        raise


@contextmanager
def systems_reason(path: Path) -> Iterator[None]:
    """Raise the operating system's error if a library fails to write to `path`.

    netCDF reports a full disk as 'HDF error' or 'Permission denied'. So `PROBE_BYTES` bytes are appended to
    the file, which is damaged already, and the operating system raises its own error.

    OSError: the file cannot be written; the error has the reason.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        with path.open("ab") as file:
            file.write(bytes(PROBE_BYTES))
        raise OSError(str(error)) from error


def _clear(target: Path) -> None:
    """Remove partial files next to `target` whose processes no longer run."""
    partial = re.compile(rf"\.{re.escape(target.stem)}\.(\d+)\.partial{re.escape(target.suffix)}")
    for path in target.parent.iterdir():
        found = partial.fullmatch(path.name)
        if found and not _runs(int(found[1])):
            path.unlink()


def _runs(process: int) -> bool:
    """Return True if a process runs, or if its state is unknown."""
    if os.name != "posix":  # elsewhere, os.kill(process, 0) may end the process
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        pass
    return True
