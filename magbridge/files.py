"""Files that are never half-written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from magbridge.errors import MagbridgeError, WriteError

__all__ = ["atomic_path"]


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path beside `path` to write to; rename it onto `path` when the block succeeds.

    When the block raises, what was written is removed and `path` is as it was. The suffix is kept,
    because some writers choose the format by it.

    Raises
    ------
    WriteError
        The operating system does not let the file be written: no folder, no permission, no room.
    """
    target = Path(path)
    beside = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        yield beside
        beside.replace(target)
    except MagbridgeError:
        raise
    except OSError as error:
        raise WriteError(target, error.strerror or str(error)) from error
    finally:
        with suppress(OSError):  # it was renamed, or never made
            beside.unlink()
