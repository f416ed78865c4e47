"""Functions of ``import magbridge`` that accept Datasets with times in seconds or as ``datetime64``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.calibration.fitting import observe
from magbridge.field import reference
from magbridge.rows import correct_rows as correct_rows_in_seconds

if TYPE_CHECKING:
    from pathlib import Path

    import xarray as xr

    from magbridge.arrays import FloatArray
    from magbridge.calibration.fitting.observations import Observations
    from magbridge.calibration.model import Calibration
    from magbridge.correction import Correction
    from magbridge.diagnose.assessment import DiagnosisResult
    from magbridge.field.grid import AnomalyGrid
    from magbridge.navigate.options import Options
    from magbridge.survey.run import Result

__all__ = [
    "correct_rows", "diagnose", "in_seconds", "navigate", "observations", "reference_field", "survey",
    "write",
]  # fmt: skip


def in_seconds(deployment: xr.Dataset) -> xr.Dataset:
    """Return a Dataset with ``time`` in seconds since 1970-01-01 UTC.

    A Dataset whose times are seconds already is returned unchanged; ``datetime64`` times are taken as UTC.
    """
    time = deployment["time"].to_numpy()
    if time.dtype.kind != "M":
        return deployment
    seconds = time.astype("datetime64[ns]").astype(np.int64) * 1e-9
    seconds[np.isnat(time)] = np.nan
    return deployment.assign_coords(time=("time", seconds, {"units": "s", "long_name": "time"}))


def observations(
    deployment: xr.Dataset, parameters: str | Sequence[str] = (), **options: Any
) -> Observations:
    """Return the complete rows of a log for a fit.

    Parameters
    ----------
    deployment : Dataset
        On ``time``, with ``mag_x mag_y mag_z`` (nT).
    parameters : str or sequence of str
        Columns that move masses.
    **options
        Further arguments of :func:`magbridge.calibration.fitting.observe.observations`.
    """
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    return observe.observations(in_seconds(deployment), names, **options)


def reference_field(deployment: xr.Dataset, grid: AnomalyGrid | None = None) -> FloatArray:
    """Return the total field of the main-field model, and of a grid, at every row, (n,) nT."""
    return reference.reference_field(in_seconds(deployment), grid)


def correct_rows(correction: Correction, deployment: xr.Dataset) -> xr.Dataset:
    """Correct a log as the bridge does; the result has the input's kind of ``time``."""
    corrected = correct_rows_in_seconds(correction, in_seconds(deployment))
    return corrected.assign_coords(time=deployment["time"])


def diagnose(deployments: Sequence[xr.Dataset], calibration: Calibration, **options: Any) -> DiagnosisResult:
    """Find what the model gets wrong in these logs; :func:`magbridge.diagnose.run.diagnose`."""
    from magbridge.diagnose import run  # noqa: PLC0415 - scipy only where it is used

    return run.diagnose([in_seconds(deployment) for deployment in deployments], calibration, **options)


def navigate(
    deployment: xr.Dataset, grid: AnomalyGrid, options: Options | None = None, **more: Any
) -> xr.Dataset:
    """Return the track that the field and a map give; :func:`magbridge.navigate.batch.navigate`."""
    from magbridge.navigate import batch  # noqa: PLC0415 - filterpy only where it is used

    return batch.navigate(in_seconds(deployment), grid, options, **more)


def survey(deployments: Sequence[xr.Dataset], *calibrations: Calibration) -> Result:
    """Level and grid the corrected samples of several logs; :func:`magbridge.survey.run.survey`.

    Parameters
    ----------
    deployments : sequence of Dataset
        Logs with a vector, which are corrected first, or with ``total_field`` or ``anomaly``.
    *calibrations : Calibration
        One for all logs with a vector, or one for each of them.
    """
    from magbridge.survey import run  # noqa: PLC0415 - scipy only where it is used

    return run.survey(run.samples_of([in_seconds(log) for log in deployments], calibrations))


def write(deployment: xr.Dataset, path: str | Path) -> None:
    """Write a Dataset to a file, in the format of its suffix."""
    from magbridge import logs  # noqa: PLC0415 - pandas only where it is used

    logs.write(in_seconds(deployment), path)
