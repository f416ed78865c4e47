"""The fit of ``calibrate``, with or without a fleet's prior, and the warnings about its data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magbridge.errors import CalibrationError, DataError, OutOfRange, WrongUse
from magbridge.files import digest
from magbridge.progress import waiting

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.fitting.fit import Fit
    from magbridge.calibration.fitting.observations import Observations
    from magbridge.fleet.start import FleetPrediction

__all__ = ["drifting", "fitted", "fleet_start", "from_fleet", "naming", "undeclared_columns"]


@contextmanager
def naming(deployment: xr.Dataset) -> Iterator[None]:
    """Name the logs in error messages about them."""
    try:
        yield
    except (CalibrationError, OutOfRange) as error:
        raise DataError(f"{deployment.attrs['source']}: {error}") from error


def fitted(
    logs: list[xr.Dataset], data: Observations, method: str, order: int, **options: Any
) -> tuple[Fit, list[str]]:
    """Return the fit, and why several logs are not of one vehicle, if they are not."""
    from magbridge.calibration.fitting.fit import fit
    from magbridge.calibration.fitting.sources import heterogeneous_logs

    def refitted(part: Observations) -> Fit:
        return fit(part, method, order)

    try:
        found = fit(data, method, order, **options)
    except CalibrationError as error:
        if doubt := heterogeneous_logs(logs, data, None, refitted):
            raise CalibrationError(doubt) from error
        raise
    doubt = heterogeneous_logs(logs, data, found, refitted)
    return found, [doubt] if doubt else []


def from_fleet(
    start: FleetPrediction, data: Observations, order: int, **options: Any
) -> tuple[Fit, list[str], dict[str, Any]]:
    """Return the fit that starts there, and what that is worth against one that does not: lines, facts."""
    from magbridge.calibration.fitting.fit import fit
    from magbridge.fleet.start import gained

    found = fit(data, order=order, known=start.known, **options)
    try:
        alone = fit(data, order=order, **options)
    except CalibrationError:
        alone = None
    facts, lines = gained(found, alone, start)
    return found, lines, {"fleet": facts}


def fleet_start(fleet: str, member: str, refit: str, files: tuple[Path, ...]) -> FleetPrediction:
    """Return a fleet's prior for these logs."""
    from magbridge.fleet.start import start

    with waiting("learning"):
        return start(fleet, member, refit, {digest(file) for file in files})


def drifting(position_sigma: float, data: Observations, method: str) -> dict[str, float]:
    """Return the option by which positions drift; WrongUse: the fit has no use for positions."""
    if position_sigma and not (data.lacks_rock and method in ("auto", "survey")):
        raise WrongUse("--position-sigma: positions matter only where the field is mapped (method survey)")
    return {"position_sigma": position_sigma} if position_sigma else {}


def undeclared_columns(deployment: xr.Dataset, data: Observations, found: Fit) -> list[str]:
    """Return a line for each column of the log that changes the field and is not a parameter."""
    import numpy as np

    from magbridge.calibration.fitting.parameter_choice import undeclared
    from magbridge.logs.info import telemetry

    rows = np.searchsorted(deployment["time"].to_numpy(), data.time)
    others = [name for name in telemetry(deployment) if name not in data.names]
    return undeclared(found.calibration, data, {name: deployment[name].to_numpy()[rows] for name in others})
