"""Declarations of the user about logs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from magbridge.logs.mapping import ColumnMapping, declared

__all__ = ["Options"]


@dataclass(frozen=True)
class Options:
    """How logs are to be read."""

    strict: bool = False
    """A log of which anything would be dropped is refused."""
    date: float | None = None
    """s since 1970 UTC of the boot, for logs whose times count from it."""
    compass: str | None = None
    """Number (from 0) or device id of the compass to use, of several; None: the one that was in use."""
    sensor_log: tuple[Path, ...] = ()
    """Logs of a sensor with its own logger, whose rows get the telemetry of the vehicle's logs."""
    clock_offset_s: float = 0.0
    """Added to the times of a sensor's own log, s."""
    column: tuple[str, ...] = ()
    """Columns under our names, each ``NAME="THEIRS [unit]"``."""
    columns: Path | None = None
    """A mapping file (:class:`magbridge.logs.mapping.ColumnMapping`), which does so for a whole file."""

    @cached_property
    def declared(self) -> ColumnMapping:
        """Combined declarations of `columns` and `column`; raise ConfigError or WrongUse for a wrong one."""
        return declared(self.column, self.columns)
