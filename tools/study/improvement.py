"""What a diagnosis gains: errors on another deployment of the vehicle, beside those of an oracle."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.model import Calibration
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.extend import extend, relinearised, with_misfit
from magbridge.diagnose.search import search
from sitl.dataset import corrected
from sitl.inject import Hidden
from study.deployment import DAY, Background, rebuilt
from study.noise import add_noise

DELAYS = ("filter_lag", "clock_offset")
"""In a uniform field these two look the same: a late field shows only where masses have moved meanwhile."""


def improvement(
    hidden: Hidden, background: Background, ds: xr.Dataset, result: Diagnosis
) -> dict[str, float]:
    """Mean square error (nT²) on another deployment: as calibrated, extended, and extended by an oracle.

    Counted are the samples whose masses stand within the range of the first deployment: beyond it a
    polynomial extrapolates. ``everywhere`` is the error of the extended calibration on all samples.
    """
    calibration, number = background.deployment.calibration, background.number + 1
    other = add_noise(rebuilt(background.deployment).measure((hidden,), number), "white", number)
    tried = {"before": calibration, "after": result.calibration, "oracle": _oracle(hidden.name, result)}
    errors = {name: error(other, c) for name, c in tried.items()}
    whole = np.all([np.isfinite(e) for e in errors.values()], axis=0)
    seen = whole & _inside(other, ds, calibration)
    found = {name: float(np.mean(e[seen] ** 2)) for name, e in errors.items()}
    return found | {"everywhere": float(np.mean(errors["after"][whole] ** 2))}


def harm(
    hidden: tuple[Hidden, ...], background: Background, ds: xr.Dataset, result: Diagnosis
) -> dict[str, float]:
    """Mean square error (nT²) against the true field, as calibrated and extended.

    Both on this log, and on one of another day (keys with " elsewhere").
    """
    calibration, number = background.deployment.calibration, background.number + 1
    other = rebuilt(background.deployment, DAY).measure(hidden, number)
    found: dict[str, float] = {}
    for log, where in ((ds, ""), (add_noise(other, background.noise, number), " elsewhere")):
        truth = log["truth_total_field"].to_numpy()
        tried = {"before": calibration, "after": result.calibration}
        errors = {name: corrected(log, c).total - truth for name, c in tried.items()}
        seen = np.isfinite(errors["after"]) & _inside(log, ds, calibration)
        found |= {name + where: float(np.mean(e[seen] ** 2)) for name, e in errors.items()}
    return found


def _inside(other: xr.Dataset, ds: xr.Dataset, calibration: Calibration) -> BoolArray:
    """Samples of a log whose masses stand within the range that those of `ds` covered."""
    inside = np.ones(other.sizes["time"], bool)
    for parameter in calibration.parameters:
        known = ds[parameter.name]
        inside &= ((other[parameter.name] >= known.min()) & (other[parameter.name] <= known.max())).to_numpy()
    return inside


def _oracle(name: str, result: Diagnosis) -> Calibration:
    """Extend as an oracle that knows the cause: its regressors alone are searched, and always accepted.

    Of the two delays it corrects the telemetry's, which has no noise; the rate of change of a reading would
    add some.
    """
    problem = result.problem
    known = "clock_offset" if name in DELAYS else name
    outcome = search(problem, CAUSES[known].candidates(problem), 1)
    model = [hypothesis.candidate for hypothesis in outcome.chosen]
    settled, _, fit = relinearised(outcome.problem, model, outcome.fit)
    return extend(settled, model, with_misfit(model, fit))


def error(ds: xr.Dataset, calibration: Calibration) -> FloatArray:
    """Error of the corrected total field against the reference, (n,) nT."""
    reference = ds["reference_field"].to_numpy() + calibration.reference.bias
    return np.asarray(corrected(ds, calibration).total - reference)
