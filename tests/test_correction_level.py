"""The common part of a corrected sigma has a column of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xarray as xr

from magbridge.calibration.model import Reference, identity
from magbridge.correction import Correction
from magbridge.rows import correct_rows


def test_level_sigma_is_what_the_level_moves() -> None:
    """A common gain of 0.2 % gives a level of 0.2 % of each field; without a level the column is missing."""
    gain = 0.002 * 50_000.0
    w = np.array([gain] * 3 + [0.0] * 6)
    plain = replace(identity(), covariance=np.outer(w, w), method="survey")
    levelled = replace(plain, level=tuple(w.tolist()), reference=Reference(50_000.0, level_sigma=100.0))
    field = np.array([[10_000.0, 0.0, 48_000.0], [0.0, 20_000.0, 40_000.0]])
    rows = xr.Dataset(
        {f"mag_{axis}": ("time", column) for axis, column in zip("xyz", field.T, strict=True)},
        coords={"time": [1e9, 1e9 + 4.0]},
    )
    corrected = correct_rows(Correction(levelled), rows)
    np.testing.assert_allclose(corrected["level_sigma"], 0.002 * np.linalg.norm(field, axis=1), rtol=1e-6)
    np.testing.assert_allclose(corrected["total_field_sigma"], corrected["level_sigma"], rtol=1e-3)
    assert "level_sigma" not in correct_rows(Correction(plain), rows)
    back = Correction(levelled)
    back._use(plain)  # as a learner that goes back to a calibration without one
    assert "level_sigma" not in correct_rows(back, rows)
