"""``[sensor.options]`` of the digitizer: what its counts are in nT."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

__all__ = ["FULL_SCALE", "DigitizerOptions"]

FULL_SCALE = 1 << 23
"""Counts at which the converter is at its reference voltage."""
Positive = Annotated[float, Meta(ge=1e-12, le=1e9)]
"""Bounded, because TOML allows ``inf``, but limits are converted to integer counts."""


class DigitizerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of the digitizer."""

    sensitivity: Positive
    """V/nT of the fluxgate's outputs, from its certificate (50 mV/µT is 5e-5)."""
    reference_voltage: Positive = 2.5
    """V at which the converter is at full scale."""
    gain: Positive = 1.0
    """Gain of the amplifier between fluxgate and converter; below 1 for a divider."""
    full_scale: Positive | None = None
    """nT at which the fluxgate itself saturates, where that is before the converter."""

    @property
    def nt_per_count(self) -> float:
        """Field of one count, in nT."""
        return self.reference_voltage / self.gain / FULL_SCALE / self.sensitivity
