r"""Fit to a survey: coefficients and the crustal field below the track, jointly.

If no true field is known, the reference is the main field. The true field is

.. math:: H_e(x, t) = |\mathrm{IGRF}| + b + f(x) + s(t),

with a bias b (the level), a Gaussian field f in space (:mod:`magbridge.estimation.gaussian_field`) and a slow
change s with time. The bias is the crustal field of a wide area, so it also has a gradient. Without the
gradient, a long log would determine the gain from the main field's decrease with height, as if the bias were
the same at every height. A criss-cross survey returns to places with other headings, rolls and positions of
the masses, which separates f from the coefficients. The errors are in the readings, as in all fits
(:mod:`magbridge.estimation.residual`): without the weight :math:`|A u|` a joint fit would shrink A, because
this shrinks the crustal field.

The offset may depend on temperature, with or without lag, and on time:

.. math:: T(t) = T + c\,(\Theta_\tau(t) - \bar\Theta) + \sum_k d_k \cos(\pi k t / t_s)

Here c (nT/degC) is the slope along each axis, for the temperature through a lag tau, and the sum is a random
walk along each axis. Without these terms the crustal field would absorb such a change of the offset. The
search of the field includes all terms; then the evidence selects those that stay.

Notes
-----
The fit iterates Gauss-Newton steps (:mod:`.rounds`). Each iteration eliminates the sparse field
(:mod:`magbridge.estimation.elimination`). The prior's widths maximise the evidence of the remaining unknowns
(:mod:`magbridge.estimation.hyperparameters`). The field's amplitude and length and the noise's
autocorrelation maximise the evidence of all unknowns (:mod:`.field_search`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect, held, lagged
from magbridge.calibration.fitting.crossings import left_open
from magbridge.calibration.fitting.field_search import about_the_middle, ladder
from magbridge.calibration.fitting.left_out import leave_out
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import Known, Vehicle, pose
from magbridge.calibration.fitting.result import Creep, Fit, assemble
from magbridge.calibration.fitting.rounds import FIRST_SAMPLES, SEARCHED, WIDE, Answer, Rounds, SurveySamples
from magbridge.calibration.fitting.solve import CoefficientPosterior, check_scales
from magbridge.calibration.fitting.uncertainty import contradicts, with_level
from magbridge.calibration.model import Calibration
from magbridge.columns import TEMPERATURE
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError, NoSolutionError
from magbridge.estimation.blocks import OffsetBlock, ParameterBlock, SlowFunctions
from magbridge.estimation.noise import NoiseModel
from magbridge.estimation.priors import Prior, PriorFamily
from magbridge.estimation.residual import rms

REFERENCE_ERROR_LENGTH_M = 25_000.0
"""Distance over which the reference's bias changes by its 1-sigma, m; 6 nT/km for 138 nT."""
SLOW, SLOW_SPREAD = 2.0, np.log(10.0)
"""Prior 1-sigma of the slow change on a magnetically quiet day, nT, and 1-sigma of its logarithm."""
DRIFTING = 2700.0
"""Half the period of the fastest drift of positions, s."""


def fit_in_place(
    data: Observations,
    order: int = 3,
    *,
    level: float,
    vehicle: Vehicle | None = None,
    position_sigma: float = 0.0,
    known: Known | None = None,
) -> Fit:
    """Fit coefficients, bias of the reference, slow changes, changes of the offset, and the crustal field.

    `level`: prior 1-sigma of the reference's constant bias, nT. `vehicle`, `known`: as for
    :func:`~.methods.fit_auto`. `position_sigma`: 1-sigma of the slow drift of dead-reckoned positions, m; the
    fit then also estimates this drift.

    CalibrationError: the data have no positions. NoSolutionError: the fit collapsed or did not converge.
    """
    if data.place is None:
        raise CalibrationError(
            "method survey: expected latitude and longitude, and a field that is not known"
        )
    # Unknowns: coefficients of the masses' positions, bias and gradient of the reference, slow changes,
    # offset terms, drift of the track, and the crustal field, which each iteration eliminates.
    posed = pose(data, order, vehicle, known)
    samples, q = posed.samples, posed.family.E.shape[1]
    groups = (*_groups(data, level), *_offered(data))
    # a drift of positions is a random walk
    waves = SlowFunctions(data.time, DRIFTING)
    moves = position_sigma > 0.0 and len(waves.shape) > 0
    drift = ParameterBlock("drift", waves, waves.shape, position_sigma) if moves else None
    survey = SurveySamples(data, samples, groups, drift)
    try:
        found, survey = _settled(survey, posed.family)
    except np.linalg.LinAlgError as problem:
        raise NoSolutionError("the fit to the survey has no solution: the crustal field is free") from problem
    prior, z = found.family.prior(found.widths.eta), found.z
    covariance = found.covariance()
    creep = survey.offset(z[q:], [one for one in survey.offsets if one.lag is None])
    # with the estimated crustal field and bias added, the reference is the true field of an ordinary fit
    lifted = replace(
        samples, reference=samples.reference + found.lacking, field=samples.field - survey.offset(z[q:])
    )
    noise = NoiseModel(found.widths.sigma, found.choice.rho, weight=survey.kept.astype(float))
    # prior and posterior of the coefficients only, without the other unknowns
    own = Prior(prior.precision[:q, :q], prior.E[:, :q], prior.offset)
    posterior = CoefficientPosterior(
        lifted, own, z[:q], covariance[:q, :q], noise, noise, settled=True, objective=0.0
    )
    check_scales(samples, posterior.coefficients)
    # held-out errors, with the estimated crustal field: the choice of parameters compares them
    details = {**_details(found, survey), "left_out_nT": leave_out(posterior, data.runs).rms}
    fit = assemble(data, posed, posterior, "survey", details=details, informative=True)
    calibration = _with_temperature(fit.calibration, data, survey.groups, (z, covariance, prior.E))
    if level:
        calibration = with_level(calibration, lifted, float(z[q]), level)
    unclear = [*left_open(data.unmapped_place, found.choice.field.length)]
    if level and contradicts(bias := float(z[q]), level):
        unclear.append(Diagnostic("level_of_reference", {"level_nT": level, "bias_nT": bias}))
    fit = replace(fit, calibration=calibration, open=tuple(unclear))
    if not creep.any():
        return fit
    # after the survey the offset may be any of its values during the survey: add their variance to that of T
    wider = calibration.covariance.copy()
    wider[6:9, 6:9] += creep.T @ creep / len(creep)
    return replace(
        fit, calibration=replace(calibration, covariance=wider), creep=Creep(data.time, creep, calibration)
    )


def _groups(data: Observations, level: float) -> tuple[ParameterBlock, ...]:
    """Return the blocks of the reference's bias, its gradient and its slow changes with time."""
    assert data.place is not None
    # the bias has the 1-sigma `level`, and changes by as much over 25 km
    away = np.nan_to_num(data.place - np.nanmean(data.place, axis=0)) / REFERENCE_ERROR_LENGTH_M
    level = max(level, 1e-3)
    bias = ParameterBlock("level", np.ones((len(data), 1)), np.ones(1), level)
    gradient = ParameterBlock("gradient", away, np.ones(3), level)
    waves = SlowFunctions(data.time)
    slow = ParameterBlock("slow change with time", waves, waves.shape, SLOW, SLOW_SPREAD, offered=True)
    return (bias, gradient, slow) if len(waves.shape) else (bias, gradient)


def _settled(survey: SurveySamples, family: PriorFamily) -> tuple[Answer, SurveySamples]:
    """Return the converged fit, and its samples with the selected optional terms."""
    # a long log converges with every second or tenth sample first, and then with all
    step = max(len(survey.kept) // FIRST_SAMPLES, 1)
    best = Rounds(survey.thinned(step), family)
    answer = best.settle()
    if step == 1:
        return answer, best.survey
    names = {group.name for group in best.survey.groups}
    survey.keep(tuple(group for group in survey.groups if group.name in names))
    best.go_on(survey, step)
    return best.settle(), survey


def _details(found: Answer, survey: SurveySamples) -> dict[str, Any]:
    part = about_the_middle(survey.place, SEARCHED, WIDE)
    choice, field, names = found.choice, found.choice.field, found.family.names
    latent = found.z[len(found.z) - sum(len(group.shape) for group in survey.groups) :]
    return {
        "log_evidence": found.score,
        "determined": found.widths.determined,
        "autocorrelation": choice.rho,
        "outliers": int((survey.at_rest & ~survey.kept).sum()),
        "widths_nT": dict(zip(names, np.exp(found.widths.eta).tolist(), strict=True)),
        "offsets_nT": {one.name: rms(survey.offset(latent, [one])) for one in survey.offsets},
        "crustal_field": {
            "rms_nT": rms(found.lacking),
            "amplitude_nT": choice.ratio * found.widths.sigma,
            "length_m": field.length,
            "smoothness": field.alpha - 1,
            "shortest_m": float(ladder(survey.place[part])[0]),
            "falls_off_upwards": field.harmonic,
            "nodes": field.nodes.size,
        },
    }


TEMPERATURE_LAGS_S = (0.0, 600.0, 2400.0)
"""Time constants between temperature and offset, s, for a bare sensor, a sensor in its housing, a hull."""
SHORTEST_DRIFT_HALF_PERIOD_S = 1200.0
"""Half the period of the fastest drift of the offset, s."""
VARIES = 0.5
"""Smallest standard deviation of a temperature whose slope is fitted, degC."""
PER_DEGREE, CREEPS, SPREAD = 1.0, 3.0, np.log(5.0)
"""Prior 1-sigma of the temperature slope (nT/degC; data sheets of fluxgates state 0.1 to 3) and of the drift
(nT) along an axis, and 1-sigma of their logarithms."""


def _offered(data: Observations) -> tuple[OffsetBlock, ...]:
    """Return the optional offset terms that a log allows: the temperature at each lag, and drift."""
    groups = []
    if data.temperature is not None and TEMPERATURE not in data.names:
        for lag in TEMPERATURE_LAGS_S:
            # a constant temperature cannot be separated from the offset
            warm = _temperature(data, lag)
            if np.std(warm) > VARIES:
                name, column = f"offset by temperature, lag {lag:.0f} s", (warm - warm.mean())[:, None]
                block = OffsetBlock(name, column, np.ones(3), PER_DEGREE, SPREAD, offered=True, lag=lag)
                groups.append(block)
    # a random walk of the offset, by slow functions of time on each axis
    waves = SlowFunctions(data.time, SHORTEST_DRIFT_HALF_PERIOD_S)
    if len(waves.shape):
        shape = np.tile(waves.shape, 3)
        groups.append(OffsetBlock("creep of the offset", waves, shape, CREEPS, SPREAD, offered=True))
    return tuple(groups)


def _temperature(data: Observations, lag: float) -> FloatArray:
    """Return the temperature (n,), degC, through a first-order lag (s); it starts at the mean if unknown."""
    assert data.temperature is not None
    known = data.temperature[np.isfinite(data.temperature)]
    return lagged(data.time, held(data.temperature, float(known.mean()) if len(known) else 0.0), lag)


def _with_temperature(
    calibration: Calibration,
    data: Observations,
    groups: tuple[ParameterBlock, ...],
    found: tuple[FloatArray, FloatArray, FloatArray],
) -> Calibration:
    """Return the calibration with the temperature term of the fit as an effect, if the fit kept one.

    `found`: unknowns z (q,), their covariance (q, q), and the matrix E (K, q) from z to the coefficients.
    """
    # The temperature term becomes a channel effect with three more coefficients, which are three of z, with
    # their covariance with all other coefficients.
    z, covariance, E = found
    row = E.shape[1] - sum(len(one.shape) for one in groups)
    for one in groups:
        if isinstance(one, OffsetBlock) and one.lag is not None:
            origin = float(_temperature(data, one.lag).mean())
            both = np.vstack([E, np.eye(3, len(z), row)])
            return replace(
                calibration,
                effects=(ChannelEffect(channel=TEMPERATURE, origin=origin, lag=one.lag),),
                coefficients=np.append(calibration.coefficients, z[row : row + 3]),
                covariance=both @ covariance @ both.T,
            )
        row += len(one.shape)
    return calibration
