"""Read and write deployments: a module for each format, a table of formats, one reader and one writer.

A deployment is an ``xarray.Dataset`` on ``time`` (:mod:`magbridge.columns`). Each row is one sample of the
magnetometer. Every other column has a value at the row's time, obtained according to the kind of log:

- in logs of a live link (``.tlog``, ``.BIN``, ``.ulg``) it is the last value received at or before the row,
  and NaN once older than 30 s. A live bridge uses the same value, so a calibration is fitted to the kind of
  data that it will correct;
- in logs that were assembled after a mission (Slocum, Seaglider) it is interpolated linearly, headings on the
  circle, and NaN in gaps.

:mod:`.registry` is the table of formats, :mod:`.access` reads and writes all of them, and :mod:`.mapping` has
the user's declarations. :mod:`.tlog` is separate: it writes the bridge's log.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magbridge.logs.access import Writer, read, read_chunks, read_each, write
    from magbridge.logs.mapping import Options
    from magbridge.logs.registry import FORMATS, suffixes

__all__ = ["FORMATS", "Options", "Writer", "read", "read_chunks", "read_each", "suffixes", "write"]

MODULES = {"FORMATS": "registry", "suffixes": "registry", "Options": "mapping"}
"""Exported name -> its module, for names that are not in :mod:`.access`."""


def __getattr__(name: str) -> Any:
    """Return an exported name, imported at its first use so that a bridge starts sooner."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULES.get(name, 'access')}"), name)
