"""Fit a calibration to observations by one of several methods."""

from __future__ import annotations

from dataclasses import replace
from inspect import signature
from numbers import Integral, Real
from pkgutil import resolve_name
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.calibration.fitting import FIT_RANGES
from magbridge.calibration.fitting.checks import judged
from magbridge.calibration.fitting.crossings import far_off, jumped, left_open, tells_rock
from magbridge.calibration.fitting.direction import with_direction
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit
from magbridge.calibration.fitting.uncertainty import with_level
from magbridge.columns import CHANNELS
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.datasets import expect, expect_number
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError, NoSolutionError, WrongUse
from magbridge.estimation.residual import robust_scale
from magbridge.field.reference import other_units
from magbridge.wording import one_of

__all__ = ["METHODS", "Fit", "fit"]

METHODS: dict[str, str] = {
    "auto": "magbridge.calibration.fitting.methods:fit_auto",
    "survey": "magbridge.calibration.fitting.in_place:fit_in_place",
    "nominal": "magbridge.calibration.fitting.methods:fit_nominal",
    "cubic": "magbridge.calibration.fitting.methods:fit_cubic",
    "runs": "magbridge.calibration.fitting.methods:fit_per_run",
    "horizontal": "magbridge.calibration.fitting.methods:fit_horizontal",
}
"""Function ``(observations, order, **options) -> Fit`` of each method, as ``module:function``."""

ONE_ATTITUDE = 5.0
"""Angle from the mean field direction within which 95 % of the samples count as a single attitude, deg."""
UNKNOWN_LENGTH = 500.0
"""Correlation length assumed for the crustal field by fits that do not estimate this field, m."""
MAX_FIT_SAMPLES = 250_000
"""Largest number of samples of a fit: more cost time, but the model's error does not average out."""
MAX_CRUST_NT = 3.0 * MAIN_FIELD_SIGMA_NT
"""Largest plausible RMS of an unmapped crustal field over a whole track, nT."""
CRUST_TEST_SAMPLES = 3000
"""Number of samples with which :func:`_rock_may_show` tests for a crustal field."""


def fit(
    data: Observations,
    method: str = "auto",
    order: int = 3,
    *,
    site_bias: float | None = None,
    **options: Any,
) -> Fit:
    """Fit a calibration to `data`.

    Parameters
    ----------
    data : Observations
        The calibration runs; :func:`~.observe.observations` reads them from a deployment.
    method : str
        One of :data:`METHODS`. ``auto`` uses ``survey`` if the reference lacks the crustal field and the
        track separates this field from heading errors, because it crosses itself or turns.
    order : int
        Highest total degree of the polynomials.
    site_bias : float
        1-sigma of a constant bias of the reference over the site, nT. A scalar fit at one site cannot
        separate the bias from the gain, so the bias enters the covariance. Default: 0 for a true field, the
        map's sigma for a map, and :data:`MAIN_FIELD_SIGMA_NT` for a main-field model without a map.
    **options
        Further arguments of the method's function, such as ``vehicle`` of
        :func:`~magbridge.calibration.fitting.methods.fit_auto`.

    Raises
    ------
    CalibrationError
        The data do not support the fit, or the method does not exist.
    WrongUse
        `data` are not observations, an option does not exist, or a value is outside its range.

    Notes
    -----
    If ``auto`` used ``survey`` and this fit has no solution, the function fits without a crustal field. If
    ``auto`` has no solution, the function uses ``nominal``, and conversely. The fit has a warning in both
    cases. If a log has more than :data:`MAX_FIT_SAMPLES` samples, the function fits every second, third ...
    sample. ``survey`` uses all samples, because it needs all passes over a place.
    """
    expect("data", data, Observations, "magbridge.observations(log)")
    if method not in METHODS:
        raise CalibrationError(f"method: {one_of(str(method), METHODS)}")
    given = {} if site_bias is None else {"site_bias": site_bias}
    _check_options(method, {"order": order, **options, **given})
    # without a true field, try the survey fit where the track separates the crustal field from the vehicle
    of_reference = MAIN_FIELD_SIGMA_NT if data.map_sigma is None else data.map_sigma
    bias = of_reference * data.lacks_rock if site_bias is None else site_bias
    in_place = method == "auto" and data.lacks_rock and tells_rock(data) and _rock_may_show(data, order)
    if in_place:
        method = "survey"
    if method != "survey":
        data = data.thinned(MAX_FIT_SAMPLES)
    if method != "survey" and options.get("position_sigma"):
        raise CalibrationError(
            "position_sigma: the log does not show the crustal field, so its positions do not matter"
        )
    # one thread: for matrices this small threads cost more than they gain, and the order of sums is fixed
    with threadpool_limits(1, "blas"):
        if wrong := other_units(data.field, float(np.median(data.reference))):  # no fit would converge
            raise CalibrationError(wrong)
        _refuse_one_attitude(data)
        # positions that jump would assign the field of one place to another
        away: tuple[Diagnostic, ...] = ()
        if method in ("auto", "survey") and data.place is not None:
            known = np.isfinite(data.place[:, :2]).all(axis=1) | (method == "survey")
            away = tuple(jumped(data.place[known, :2], data.time[known]))
            data = data.part(~(far_off(data.place[:, :2]) & known))
        found, method, notes = _first_solution(data, method, order, bias, in_place, options)
        if method == "auto":
            found = replace(found, open=tuple(left_open(data.unmapped_place, UNKNOWN_LENGTH)))
        found = replace(found, open=(*away, *notes, *found.open))
        flight = found.details.pop("flown", None)
        if flight is not None and not flight.all():
            data = data.part(flight)
            found.details["ends"] = int((~flight).sum())
        found = found if method == "survey" else _biased(found, bias)
        if data.independent_headings and not (found.calibration.effects or found.creep):
            found = with_direction(found, data, headings=True)
        calibration = replace(found.calibration, conditions=data.conditions())
        return judged(replace(found, calibration=calibration), data)


def _check_options(method: str, options: dict[str, Any]) -> None:
    """Check the options of a method; WrongUse: a name is unknown, or a value is out of range."""
    tried = ("auto", "survey") if method == "auto" else (method,)
    names = {name for one in tried for name in signature(resolve_name(METHODS[one])).parameters} - {"data"}
    for name, value in options.items():
        if name not in names | {"order", "site_bias"}:
            raise WrongUse(f"option of fit: {one_of(name, sorted(names))}")
        if name in FIT_RANGES:
            expect_number(name, value, *FIT_RANGES[name], Integral if name == "order" else Real)


def _first_solution(
    data: Observations, method: str, order: int, bias: float, in_place: bool, options: dict[str, Any]
) -> tuple[Fit, str, tuple[Diagnostic, ...]]:
    """Return the fit of the first method with a solution, its name, and why others were not used.

    `in_place`: True if ``survey`` is the first choice. CalibrationError: no method has a solution.
    """
    # each attempt: method, data, options, and the notes that explain why it is not the first choice
    bare = data.without_parameters()
    attempts: list[tuple[str, Observations, dict[str, Any], tuple[Diagnostic, ...]]] = []
    if method == "survey":
        attempts.append(("survey", data, {"level": bias, **options}, ()))
    if method != "survey" or (in_place and "position_sigma" not in options):
        lacking: tuple[Diagnostic, ...] = (Diagnostic("no_field_in_place"),) if in_place else ()
        attempts.append(("auto" if in_place else method, data, options, lacking))
    if attempts[-1][0] == "auto" and not options:
        attempts.append(("nominal", bare, {}, (*attempts[-1][3], Diagnostic("one_ellipsoid"))))
    elif method == "nominal" and not options:
        attempts.append(("auto", bare, {}, (Diagnostic("without_parameters"),)))
    failures: list[CalibrationError] = []
    for name, part, own, notes in attempts:
        try:
            found = resolve_name(METHODS[name])(part, order, **own)
            if in_place:
                _refuse_large_crust(found)
        except NoSolutionError as error:
            failures.append(error)
        except CalibrationError as error:
            if not in_place or failures:
                raise
            failures.append(error)
        else:
            return found, name, notes
    raise failures[0]


def _refuse_large_crust(found: Fit) -> None:
    """Raise NoSolutionError if a fitted crustal field is so large that it must be a sensor error."""
    if (size := found.details.get("crustal_field", {}).get("rms_nT", 0.0)) > MAX_CRUST_NT:
        raise NoSolutionError(
            f"survey: a crustal field of {size:.0f} nT RMS was fitted, larger than any crust's"
        )


def _rock_may_show(data: Observations, order: int) -> bool:
    """Return True if a fit without crustal field leaves a residual of a crust's size, or has no solution."""
    few = data.thinned(CRUST_TEST_SAMPLES)
    for method in ("nominal", "auto"):
        try:
            with threadpool_limits(1, "blas"):
                if robust_scale(resolve_name(METHODS[method])(few, order).residual) <= MAX_CRUST_NT:
                    return True
        except CalibrationError:
            return True
    return False


def _biased(found: Fit, sigma: float) -> Fit:
    """Return the fit with its covariance enlarged by a bias of the reference, of 1-sigma `sigma`, nT."""
    if not sigma:
        return found
    calibration = found.calibration
    field = calibration.reference.field
    # A scales with the reference: a bias of dF moves A by A dF / F, and leaves T
    v = calibration.coefficients.reshape(-1, 9) / field
    v[0, :3] += 1.0
    v[:, 6:] = 0.0
    P = calibration.covariance + sigma**2 * np.outer(v, v)
    wider = replace(calibration, covariance=P)
    updated = found.information and found.information.blurred(v.ravel(), sigma)
    return replace(found, calibration=with_level(wider, found.samples, 0.0, sigma), information=updated)


def _refuse_one_attitude(data: Observations) -> None:
    """Raise CalibrationError if all samples have one attitude, or a channel is stuck."""
    if 0 < (stuck := np.flatnonzero(np.ptp(data.field, axis=0) == 0.0)).size < 3:
        which = CHANNELS[int(stuck[0])]
        raise CalibrationError(
            f"{which} is {data.field[0, stuck[0]]:g} in every sample: the channel is stuck"
        )
    # angles between the readings and their mean direction
    unit = data.field / np.linalg.norm(data.field, axis=1)[:, None]
    middle = unit.mean(axis=0)
    off = np.degrees(np.arccos(np.clip(unit @ middle / np.linalg.norm(middle), -1.0, 1.0)))
    if np.quantile(off, 0.95) < ONE_ATTITUDE:
        raise CalibrationError(
            f"all samples lie within {np.quantile(off, 0.95):.1f} degrees of one attitude: "
            "fly turns (full circles, dives and climbs)"
        )
