"""Read and write deployments: a module for each format, a table of formats, one reader and one writer.

A deployment is an ``xarray.Dataset`` on ``time`` (:mod:`magbridge.columns`). A row is one time of the
magnetometer sample; every other column holds the values known at that time:

- logs of a live link (``.tlog``, ``.BIN``, ``.ulg``): the last value received at or before the row, NaN once
  it is older than 30 s. The bridge itself would have known this, so a calibration is fitted to the same kind
  of data as it will correct live;
- logs that were assembled ashore (Slocum, Seaglider): interpolated linearly, headings on the circle, NaN
  across gaps.

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
"""The module of each name that is not in :mod:`.access`."""


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: a bridge, which only writes its log, starts sooner."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULES.get(name, 'access')}"), name)
