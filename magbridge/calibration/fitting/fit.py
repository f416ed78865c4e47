"""Fit a calibration: one function, and a table of methods behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape
from importlib import import_module
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.crossings import far_off, jumped, left_open, tells_rock
from magbridge.calibration.fitting.judged import judged
from magbridge.calibration.fitting.known import Information
from magbridge.calibration.fitting.left_out import LeftOut
from magbridge.calibration.fitting.level import with_level
from magbridge.calibration.fitting.noise import NoiseModel
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.offset_terms import Creep
from magbridge.calibration.fitting.prior import Prior
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference, Run, Sensor
from magbridge.calibration.residual import Samples, residuals_of, rms, robust_scale, scales_and_offsets
from magbridge.calibration.terms import Polynomial
from magbridge.errors import CalibrationError
from magbridge.field.reference import other_units
from magbridge.version import __version__

__all__ = ["METHODS", "Fit", "assemble", "fit"]

METHODS: dict[str, str] = {
    "auto": "magbridge.calibration.fitting.auto:fit_auto",
    "survey": "magbridge.calibration.fitting.in_place:fit_in_place",
    "nominal": "magbridge.calibration.fitting.nominal:fit_nominal",
    "cubic": "magbridge.calibration.fitting.cubic:fit_cubic",
    "runs": "magbridge.calibration.fitting.per_run:fit_per_run",
    "horizontal": "magbridge.calibration.fitting.horizontal:fit_horizontal",
}
"""Name -> ``module:function``, each ``(observations, order, **options) -> Fit``."""

ONE_ATTITUDE = 5.0
"""deg: all samples within that of their mean direction are one attitude."""
NOT_FOUND = "the rock could not be found with the calibration: what it does is left in the errors"
UNKNOWN_LENGTH = 500.0
"""m, taken for the rock's where no field in place was fitted."""
LEVEL = 145.0
"""nT, 1-sigma by which the total field at a site differs from a main-field model's: what its degrees do not
reach, the crust above all (error model of the World Magnetic Model 2020, Chulliat et al. 2020)."""
ROCK, JUDGED = 3.0 * LEVEL, 3000
"""nT, more than which no rock leaves over a whole track; and samples that are enough to see that."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Attributes
    ----------
    calibration : Calibration
    residual : (n,) array
        nT in the sensor's own units: ``(F - H_e) / |A^T u|``.
    warnings : tuple of str
        What the data could not determine, in words for a pilot.
    details : dict
        Numbers of the method: evidence, widths, how many numbers were determined; rank, and the 1-sigma of
        each estimable combination from the data alone (nT).
    samples : Samples
        The data as fitted, for :mod:`.identify`.
    open : tuple of str
        What the track leaves open, which is a reason for an error that is large.
    information : Information or None
        What the data alone say of the coefficients; None where the method's prior is none of all of them.
    creep : Creep or None
        How the sensor's offset crept meanwhile, where the data show that it did.
    """

    calibration: Calibration
    residual: FloatArray
    warnings: tuple[str, ...]
    details: dict[str, Any]
    samples: Samples
    open: tuple[str, ...] = ()
    information: Information | None = None
    creep: Creep | None = None

    def __repr__(self) -> str:
        count = f", {len(self.calibration.warnings)} warnings" if self.calibration.warnings else ""
        return f"<Fit: {self.rms:.2f} nT RMS of {len(self.residual)} samples{count}; {self.calibration!r}>"

    def _repr_html_(self) -> str:
        """Return the same for a notebook, with the warnings."""
        warnings = "".join(f"<li>{escape(warning)}</li>" for warning in self.warnings)
        return f"<p>{escape(repr(self))}</p>" + f"<ul>{warnings}</ul>" * bool(warnings)

    @property
    def supported(self) -> bool:
        """Whether the calibration is without doubts: ``--strict`` demands it.

        The error expected elsewhere is not large against the noise, and the headings have no wide gap.
        """
        return not self.calibration.warnings

    @property
    def scales(self) -> tuple[float, float]:
        """Smallest and largest scale of A at the samples: a fit can reduce its residual by shrinking them."""
        step = max(len(self.samples.phi) // 1000, 1)
        scales, _ = scales_and_offsets(
            self.samples.part(slice(None, None, step)), self.calibration.without_effects().coefficients
        )
        return float(scales.min()), float(scales.max())

    @property
    def rms(self) -> float:
        """RMS of the residual, nT."""
        return rms(self.residual)


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
        The calibration runs; :func:`~.observe.observations` takes them from a deployment.
    method : str
        One of :data:`METHODS`. Where the reference lacks the rock and the track crosses itself or turns, so
        that it tells rock from heading, ``auto`` is ``survey``. (The last of five dives of a Seaglider along
        one line, left out: 88 nT without a field in place, 94 with it.)
    order : int
        Highest total degree of the polynomials.
    site_bias : float
        nT, 1-sigma of a constant error of the reference over the site. No scalar fit at one site can tell
        it from the gain, so it goes into the covariance. By default none of a true field, of a map that of
        the map, and of a main-field model alone :data:`LEVEL`.
    **options
        Further arguments of the method's own function, as ``vehicle`` of
        :func:`~magbridge.calibration.fitting.auto.fit_auto`.

    Raises
    ------
    CalibrationError
        The data do not support the fit, or there is no such method. Where ``auto`` is ``survey`` and that fit
        has no answer, it is one without a field in place, and the calibration warns of it.
    """
    if method not in METHODS:
        raise CalibrationError(f"method {method!r} is not known: one of {', '.join(METHODS)}")
    bias = _default_bias(data) if site_bias is None else site_bias
    in_place = method == "auto" and data.lacks_rock and tells_rock(data) and _rock_may_show(data, order)
    if in_place:
        method = "survey"
    if method != "survey" and options.get("position_sigma"):
        raise CalibrationError(
            "position_sigma: the log does not show the rock, so its positions do not matter"
        )
    # one thread: for matrices this small threads cost more than they gain, and the order of sums is fixed
    with threadpool_limits(1, "blas"):
        if wrong := other_units(data.field, float(np.median(data.reference))):  # no fit would settle
            raise CalibrationError(wrong)
        _refuse_one_attitude(data)
        away: tuple[str, ...] = ()
        if method in ("auto", "survey") and data.place is not None:
            known = np.isfinite(data.place[:, :2]).all(axis=1) | (method == "survey")
            away = tuple(jumped(data.place[known, :2], data.time[known]))
            data = data.part(~(far_off(data.place[:, :2]) & known))
        try:
            level = {"level": bias} if method == "survey" else {}
            found = _function(method)(data, order, **level, **options)
        except CalibrationError:
            if not in_place or "position_sigma" in options:
                raise
            method, away = "auto", (*away, NOT_FOUND)
            found = _function(method)(data, order, **options)
        if method == "auto":
            found = replace(found, open=tuple(left_open(data, UNKNOWN_LENGTH)))
        found = replace(found, open=(*away, *found.open))
        if (kept := found.details.pop("flown", None)) is not None:
            data = data.part(kept)
            found.details["ends"] = int((~kept).sum())
        return judged(found if method == "survey" else _biased(found, bias), data)


def _function(method: str) -> Callable[..., Fit]:
    module, _, name = METHODS[method].partition(":")
    function: Callable[..., Fit] = getattr(import_module(module), name)
    return function


def _rock_may_show(data: Observations, order: int) -> bool:
    """Tell whether a fit without rock leaves no more than rock can be: among a drone's motors it does."""
    few = data.part(np.arange(len(data)) % max(len(data) // JUDGED, 1) == 0)
    for method in ("nominal", "auto"):
        try:
            with threadpool_limits(1, "blas"):
                if robust_scale(_function(method)(few, order).residual) <= ROCK:
                    return True
        except CalibrationError:
            return True
    return False


def _default_bias(data: Observations) -> float:
    """Return how well the reference's level is known, nT, as far as nobody says so."""
    if not data.lacks_rock:
        return 0.0
    return LEVEL if data.map_sigma is None else data.map_sigma


def _biased(found: Fit, sigma: float) -> Fit:
    """Carry an unknown bias of the reference into the covariance: ``dA = A dF / F`` at all positions."""
    if not sigma:
        return found
    calibration = found.calibration
    field = calibration.reference.field
    v = calibration.coefficients.reshape(-1, 9) / field
    v[0, :3] += 1.0
    v[:, 6:] = 0.0
    P = calibration.covariance + sigma**2 * np.outer(v, v)
    wider = replace(calibration, covariance=P)
    updated = found.information and found.information.blurred(v.ravel(), sigma)
    return replace(found, calibration=with_level(wider, found.samples, 0.0, sigma), information=updated)


def _refuse_one_attitude(data: Observations) -> None:
    """Refuse samples of one attitude: they cannot separate the sensor's errors from the field."""
    unit = data.field / np.linalg.norm(data.field, axis=1)[:, None]
    middle = unit.mean(axis=0)
    off = np.degrees(np.arccos(np.clip(unit @ middle / np.linalg.norm(middle), -1.0, 1.0)))
    if np.quantile(off, 0.95) < ONE_ATTITUDE:
        raise CalibrationError(
            f"all samples lie within {np.quantile(off, 0.95):.1f} degrees of one attitude: "
            "fly turns (full circles, dives and climbs)"
        )


def assemble(
    data: Observations,
    samples: Samples,
    parameters: tuple[Parameter, ...],
    exponents: tuple[tuple[int, ...], ...],
    coefficients: FloatArray,
    covariance: FloatArray,
    noise: NoiseModel,
    method: str,
    left_out: LeftOut | None = None,
    prior: Prior | None = None,
    details: dict[str, Any] | None = None,
) -> Fit:
    """Return the fit: its numbers as a calibration with a table of runs, and its residuals.

    Parameters
    ----------
    data, samples
        The calibration runs, and what was fitted of them.
    parameters, exponents
        The positions that the coefficients depend on, and the m monomials in them.
    coefficients : (9 m,) array
        nT, monomial by monomial.
    covariance : (9 m, 9 m) array
        nT².
    noise, method, details
        As :class:`Fit` and its calibration have them.
    left_out : LeftOut, optional
        What the fit is worth on parts left out: the sigmas grow by its ratio.
    prior : Prior, optional
        Of all coefficients, as they were fitted with it.
    """
    e = residuals_of(samples, coefficients)
    information = Information.left_by(prior, coefficients, covariance) if prior is not None else None
    if left_out is not None:
        information = information and information.divided(left_out.ratio)
        noise, covariance = replace(noise, sigma=noise.sigma * left_out.ratio), covariance * left_out.ratio**2
        details = {**(details or {}), "left_out_nT": left_out.rms, "left_out_ratio": left_out.ratio}
    steps = np.diff(data.time)
    calibration = Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=coefficients,
        covariance=covariance,
        noise=Noise(
            noise.sigma,
            samples.kappa * noise.sigma,
            noise.autocorrelation,
            float(np.median(steps)) if steps.size else 0.0,
            noise.white,
        ),
        reference=Reference(samples.F_0, data.model),
        sensor=Sensor(data.sensor),
        runs=_runs(data, e),
        method=method,
        inputs=dict(data.inputs),
        software=f"magbridge {__version__}",
    )
    return Fit(calibration, e, (), details or {}, samples, information=information)


def _runs(data: Observations, e: FloatArray) -> tuple[Run, ...]:
    """Return each run's samples, RMS residual (nT) and mean positions."""
    labels, which = np.unique(data.runs, return_inverse=True)
    count = np.bincount(which)
    squares = np.bincount(which, e * e)
    places = [np.bincount(which, column) / count for column in data.parameters.T]
    return tuple(
        Run(str(label), int(n), float(np.sqrt(square / n)), tuple(map(float, place)))
        for label, n, square, *place in zip(labels, count, squares, *places, strict=True)
    )
