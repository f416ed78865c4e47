"""Write a text file and read it as a log."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from magbridge import logs
from magbridge.logs import Options

NOON = 1_651_665_600.0
"""2022-05-04T12:00:00Z, s since 1970."""


def read(folder: Path, text: str | bytes, name: str = "log.csv", **options: Any) -> xr.Dataset:
    """Write a text to the file `name` in a folder; return it as a log, read with `options`."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return logs.read(path, options=Options(**options))


def lines(header: str, row: Callable[[int], str], rows: int = 40) -> str:
    """Return the text of a table: its header, and a line for each row."""
    return "\n".join([header, *map(row, range(rows))]) + "\n"
