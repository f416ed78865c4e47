"""Parameters that can be changed while the bridge runs: their table and their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from struct import pack, unpack

import msgspec

from magbridge.config import Align, Telemetry

__all__ = [
    "Parameters", "Tunable", "alignment", "file_rate", "learning", "rate_name", "rates", "telemetry_ages",
]  # fmt: skip


class Tunable(msgspec.Struct, frozen=True):
    """One parameter."""

    name: str
    """On the link, at most 16 characters."""
    key: str
    """In the configuration."""
    default: float
    low: float
    high: float
    """`default`, `low`, `high`: In `unit`; `low` and `high` are the limits, themselves allowed."""
    unit: str
    doc: str
    """One line."""


def alignment(align: Align) -> list[Tunable]:
    """Return the tunables of ``[align]``."""
    earths = "the Earth's field about the main field"
    rows = (
        ("MB_FILT_DELAY", "filter_delay", 0, 60, "s", "delay of the anti-alias filter"),
        ("MB_GAP_FACTOR", "gap_factor", 1.01, 1000, "", "sample periods without a sample that are a gap"),
        ("MB_MOVING_RATE", "moving_rate", 1e-6, 10, "1/s", "ranges per second from which on a mass moves"),
        ("MB_SETTLE_TIME", "settle_time", 0, 3600, "s", "how long samples stay flagged after a motion"),
        ("MB_STALE_GROW", "stale_growth", 0, 1e4, "nT/s", "growth of sigma with the age of stale telemetry"),
        ("MB_REF_SIGMA", "reference_sigma", 1e-3, 1e9, "nT", f"1-sigma of {earths}"),
        ("MB_TURNON_SIGMA", "turn_on_sigma", 0, 1e5, "nT", "1-sigma of the offset's change at power-on"),
    )
    return [
        Tunable(name, f"align.{key}", float(getattr(align, key)), low, high, unit, doc)
        for name, key, low, high, unit, doc in rows
    ]


def file_rate() -> list[Tunable]:
    """Return the tunable for the rate at which files are sent."""
    doc = "at which files are sent to stations; 0 sends none"
    return [Tunable("MB_FILE_RATE", "files.rate", 250.0, 0, 10_000, "kB/s", doc)]


def learning(enabled: bool) -> list[Tunable]:
    """Return the tunables of ``[learning]``."""
    rows = (
        ("MB_LEARN", "enabled", float(enabled), 1, "whether the calibration is learned in flight"),
        ("MB_LEARN_FREEZE", "freeze", 0.0, 1, "1: compare and raise alarms, but learn nothing"),
        ("MB_LEARN_CMD", "cmd", 0.0, 2, "1 accepts the learned calibration, 2 forgets it; goes back to 0"),
    )
    return [
        Tunable(name, f"learning.{key}", default, 0, high, "", doc) for name, key, default, high, doc in rows
    ]


def telemetry_ages(telemetry: Mapping[str, Telemetry]) -> list[Tunable]:
    """Return one tunable for the ``max_age`` of each telemetry parameter."""
    rows: dict[str, Tunable] = {}
    for number, (name, what) in enumerate(telemetry.items()):
        short = f"MB_AGE_{name.upper()}"[:16]
        if short in rows:
            short = f"MB_AGE_{number}"
        rows[short] = Tunable(
            short, f"telemetry.{name}.max_age", what.max_age, 0.01, 1e6, "s", f"older {name} is stale"
        )
    return list(rows.values())


def rate_name(message: str) -> str:
    """Return the name of the parameter that holds the rate of `message`."""
    return f"MB_R_{message.removeprefix('MAG_')}"[:16]


def rates(defaults: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> list[Tunable]:
    """Return one tunable for the rate of each message of `limits`; one without a default is off."""
    doc = "rate of {}; 0 with every sample, -1 off"
    return [
        Tunable(rate_name(of), f"publish.{of}", defaults.get(of, -1.0), low, high, "Hz", doc.format(of))
        for of, (low, high) in limits.items()
    ]


def real32(value: float) -> float:
    """Return `value` rounded to float32, as a message carries it."""
    return float(unpack("<f", pack("<f", value))[0])


class Parameters:
    """The values of a table of tunables.

    A value that was never set is exactly the default, not rounded to float32, so that an untuned bridge
    computes with the configuration's own numbers.

    Attributes
    ----------
    table : dict of str to Tunable
        By name, in order: the order gives the index on the link.
    revision : int
        Grows with every change.
    """

    def __init__(self, table: Iterable[Tunable]) -> None:
        self.table = {row.name: row for row in table}
        self.names = list(self.table)
        self.revision = 0
        self._watchers: list[Callable[[str], None]] = []
        self._values = {row.name: float(row.default) for row in self.table.values()}
        self._names_of = {row.key: row.name for row in self.table.values()}

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def value_of(self, key: str) -> float:
        """Return the value that the configuration calls `key`."""
        return self._values[self._names_of[key]]

    def changed(self) -> dict[str, float]:
        """Return the values that differ from the defaults, by name; these are stored."""
        return {name: value for name, value in self._values.items() if value != self.table[name].default}

    def watch(self, watcher: Callable[[str], None]) -> None:
        """Call ``watcher(name)`` at every later change, so that the value takes effect."""
        self._watchers.append(watcher)

    def set(self, name: str, value: float) -> bool:
        """Set a value; return False and change nothing if it is not finite or out of range."""
        row = self.table[name]
        if not isfinite(value) or abs(value) > 1e38:
            return False
        short = real32(value)
        if not real32(row.low) <= short <= real32(row.high):
            return False
        if short == real32(self._values[name]):
            return True
        self._values[name] = row.default if short == real32(row.default) else short
        self.revision += 1
        for watcher in self._watchers:
            watcher(name)
        return True

    def restore(self, values: Mapping[str, float]) -> list[str]:
        """Set the stored values of an earlier run; return names that no longer exist or fit."""
        return [name for name, value in values.items() if name not in self.table or not self.set(name, value)]
