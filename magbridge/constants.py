"""Errors of a main-field model: one generation, the World Magnetic Model 2025, for all packages.

The model lacks high degrees, mainly the crustal field, and disturbances. Source: error model of the WMM2025
(technical report, NOAA National Centers for Environmental Information, 2025).
"""

from __future__ import annotations

from typing import Final

__all__ = ["DECLINATION_SIGMA_DEG", "DECLINATION_SIGMA_NT_DEG", "MAIN_FIELD_SIGMA_NT"]

MAIN_FIELD_SIGMA_NT: Final = 138.0
"""1-sigma of the total field at a site about the model, nT."""
DECLINATION_SIGMA_DEG: Final = 0.26
"""1-sigma of the declination in a strong horizontal field, deg: the constant term of ``sqrt(0.26^2 + (5417
nT / H)^2)``."""
DECLINATION_SIGMA_NT_DEG: Final = 5417.0
"""Term of the declination's error that is inversely proportional to the horizontal field H, deg nT."""
