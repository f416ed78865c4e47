"""Statistics of a corrected log."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from magbridge.columns import CHANNELS
from magbridge.records import Quality
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Tally"]


@dataclass
class Tally:
    """Statistics of a log so far."""

    samples: int = 0
    left_out: int = 0
    """`samples`, `left_out`: Rows corrected, and rows that are not samples."""
    flagged: int = 0
    """Samples whose total field is flagged."""
    flags: Counter[str] = field(default_factory=Counter)
    """Name of a flag -> samples that carry it."""
    unearthly: int = 0
    """Samples whose total field is none of the Earth's."""

    def add(self, corrected: xr.Dataset, rows: int) -> None:
        """Count a piece of the log that had so many rows, with its samples corrected."""
        from magbridge.field.reference import MAIN_FIELD_RANGE_NT

        self.samples += corrected.sizes["time"]
        self.left_out += rows - corrected.sizes["time"]
        doubtful = ~Quality.NO_BORESIGHT  # without a boresight, the total field is just as good
        quality = corrected["quality"].to_numpy().astype(int)
        self.flagged += int((quality & doubtful != 0).sum())
        self.flags.update({flag.names(): int((quality & flag != 0).sum()) for flag in doubtful})
        total = corrected["total_field"]
        self.unearthly += int(((total < MAIN_FIELD_RANGE_NT[0]) | (total > MAIN_FIELD_RANGE_NT[1])).sum())

    def doubt(self) -> str:
        """Return why the calibration may be another vehicle's; empty without such an indication."""
        from magbridge.field.reference import MAIN_FIELD_RANGE_NT

        if self.unearthly <= self.samples / 2:
            return ""
        low, high = (f"{limit:,.0f}" for limit in MAIN_FIELD_RANGE_NT)
        return (
            f"another vehicle's? {self.unearthly} of {self.samples} corrected total fields are none of the "
            f"Earth's, {low} to {high} nT"
        )

    def facts(self) -> dict[str, Any]:
        """Return the numbers to print as JSON."""
        left_out = {"left_out": self.left_out}
        return {"rows": self.samples, "flagged": self.flagged, "flags": +self.flags, **left_out}

    def summary(self) -> str:
        """Return the numbers in a sentence."""
        named = ", ".join(f"{name} {count}" for name, count in (+self.flags).items())
        text = f"{counted(self.samples, 'sample')}, {self.flagged} of them flagged"
        text += f" ({named})" if named else ""
        if self.left_out:
            text += f"; {counted(self.left_out, 'row')} without any of {' '.join(CHANNELS)} left out"
        return text
