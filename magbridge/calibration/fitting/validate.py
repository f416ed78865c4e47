"""The only figure that counts: how well runs are corrected that the fit never saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import rms
from magbridge.errors import CalibrationError

__all__ = ["HeldOut", "in_sensor_units", "leave_runs_out"]

FloatArray = NDArray[np.float64]
FEWEST = 30
"""Samples of a run that is worth leaving out."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of samples whose whole run was left out of the fit.

    Attributes
    ----------
    error : (n,) array
        nT, in the sensor's own units; NaN where a run was too short to be left out.
    standardised : (n,) array
        Error of the corrected total field over its sigma.
    runs : (n,) array
        Labels.
    """

    error: FloatArray
    standardised: FloatArray
    runs: NDArray[np.generic]

    @property
    def rms(self) -> float:
        """RMS error, nT."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    def by_run(self) -> dict[str, float]:
        """RMS error of each run, nT."""
        kept = np.isfinite(self.error)
        return {
            str(label): rms(self.error[kept & (self.runs == label)]) for label in np.unique(self.runs[kept])
        }


def leave_runs_out(data: Observations, method: str = "auto", order: int = 3, **options: Any) -> HeldOut:
    """Fit without each run in turn, and correct that run.

    Parameters are those of :func:`~magbridge.calibration.fitting.fit.fit`.

    Raises
    ------
    CalibrationError
        There are not two runs, or what is left without one cannot be fitted.
    """
    labels, counts = np.unique(data.runs, return_counts=True)
    labels = labels[counts >= FEWEST]
    if len(labels) < 2:
        raise CalibrationError(f"leaving runs out: found {len(labels)} run of {FEWEST} samples, 2 are needed")
    error, standardised = np.full(len(data), np.nan), np.full(len(data), np.nan)
    for label in labels:
        out = np.asarray(data.runs == label)
        calibration = fit(data.part(~out), method, order, **options).calibration
        error[out], standardised[out] = in_sensor_units(calibration, data.part(out))
    return HeldOut(error, standardised, np.asarray(data.runs))


def in_sensor_units(calibration: Calibration, data: Observations) -> tuple[FloatArray, FloatArray]:
    """Return the error of the total field over ``|A^T u|`` (n,), nT of the sensor; and over its sigma (n,).

    A fit that shrinks A shrinks every error of the corrected field, but gains nothing in the sensor's units.
    """
    k = len(calibration.parameters)
    positions = data.parameters[:, :k]
    got = correct(calibration, data.field, positions, data.time)
    A, T = calibration.matrices(positions)
    b = np.matmul(A, (data.field - T)[:, :, None])
    size = np.linalg.norm(np.matmul(A, b)[:, :, 0], axis=1) / got.total
    error = got.total - data.reference
    return error / size, error / got.sigma
