"""Test the effects that a diagnosis adds: equal bits live and in batch, and right derivatives."""

import re
from dataclasses import replace

import numpy as np
import pytest
from posed import EFFECTS, FIELD, T0, calibrated, regressors_of, surveyed, walk

from magbridge.calibration.correct import Corrector, correct
from magbridge.calibration.effects import (
    ChannelEffect,
    ClockEffect,
    PlayEffect,
    PowersEffect,
    RateEffect,
    ResponseEffect,
    TimeEffect,
)
from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import Effect
from magbridge.diagnose.columns import effect_columns
from magbridge.diagnose.problem import pose, samples_of
from magbridge.diagnose.survey import Survey, TelemetryChannel
from magbridge.errors import FormatError
from magbridge.estimation.residual import residuals


@pytest.fixture(scope="module")
def survey() -> Survey:
    rng = np.random.default_rng(5)
    n = 300
    plain = surveyed(walk(n, rng), np.sin(np.arange(n) / 20.0))
    heat = TelemetryChannel(3.0 + rng.normal(size=n).cumsum() * 0.1, "degC", ("temperature",))
    return replace(
        plain, field=plain.field + np.array([300.0, -200.0, 500.0]), channels=plain.channels | {"heat": heat}
    )


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    rng = np.random.default_rng(6)
    coefficients = rng.normal(0, 100.0, 27)
    coefficients[6:9] = [300.0, -200.0, 500.0]
    return calibrated(coefficients)


def with_values(calibration: Calibration, effect: Effect, values: np.ndarray) -> Calibration:
    """Return the calibration with the effect and exactly known coefficients."""
    return replace(
        calibration,
        effects=(effect,),
        coefficients=np.append(calibration.coefficients, values),
        covariance=np.pad(calibration.covariance, (0, effect.size)),
    )


def sizes(effect: Effect) -> np.ndarray:
    unit = 0.1 if isinstance(effect, (RateEffect, ClockEffect)) else 5.0
    return unit * np.random.default_rng(7).normal(size=effect.size)


@pytest.fixture(scope="module")
def agreeing(survey: Survey, calibration: Calibration) -> Survey:
    """Return the survey with the corrected field as reference, because derivatives are taken there."""
    channels = survey.values(calibration.channels)
    return replace(survey, reference=correct(calibration, survey.field, channels, survey.time).total)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.cause)
def test_live_and_batch_agree_and_survive_the_file(
    effect: Effect, survey: Survey, calibration: Calibration
) -> None:
    extended = decode_calibration(encode_calibration(with_values(calibration, effect, sizes(effect))))
    channels = survey.values(extended.channels)
    channels[40:50] = np.nan
    field = survey.field.copy()
    field[100, 1] = np.nan
    batch = correct(extended, field, channels, survey.time)
    live = Corrector(extended)
    for i, t in enumerate(survey.time):
        one = live.step(round(t * 1e6), tuple(field[i].tolist()), channels[i].tolist())
        np.testing.assert_allclose(one.total_field, batch.total[i], rtol=1e-12)
        np.testing.assert_allclose(one.total_field_sigma, batch.sigma[i], rtol=1e-9)
    assert np.isfinite(batch.total).sum() > 200


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.cause)
def test_the_search_uses_the_models_own_derivative(
    effect: Effect, agreeing: Survey, calibration: Calibration
) -> None:
    """Compare a coefficient's derivative of the residual with a difference of the whole model."""
    problem = pose(agreeing, calibration)
    columns = effect_columns(problem, effect, regressors_of(agreeing, calibration, effect))(
        slice(0, len(agreeing))
    )
    for k in range(effect.size):
        step = np.zeros(effect.size)
        step[k] = 1e-3
        above, below = (
            residuals(*samples_of(agreeing, with_values(calibration, effect, s * step)))[0]
            for s in (1.0, -1.0)
        )
        # a coefficient that the calibration already contains is missing in the residual
        np.testing.assert_allclose(
            -(above - below) / 2e-3, columns[:, k], rtol=1e-4, atol=1e-5 + 1e-4 * np.abs(columns).max()
        )


def test_the_calibrations_own_columns_are_derivatives_too(agreeing: Survey, calibration: Calibration) -> None:
    problem = pose(agreeing, calibration)
    jacobian = problem.coefficient_jacobian
    own = jacobian.shape[1]
    assert not problem.directions[:, own:].any()  # the last are delays of the log's
    for k in range(own):

        def moved(s: float, k: int = k) -> np.ndarray:
            c = replace(calibration, coefficients=calibration.coefficients + s * problem.directions[:, k])
            return residuals(*samples_of(agreeing, c))[0]

        difference = (moved(1e-3) - moved(-1e-3)) / 2e-3
        np.testing.assert_allclose(-difference, jacobian[:, k], atol=1e-5 * np.abs(jacobian).max())


@pytest.mark.parametrize(
    ("effect", "line"),
    [
        (PlayEffect(cause="hysteresis", channel="p", width=0.3, centre=0.1, scale=0.0),
         "scale: Expected `float` >= 1e-09"),
        (PlayEffect(cause="hysteresis", channel="p", width=0.0, centre=0.1, scale=0.5),
         "width: Expected `float` >= 1e-09"),
        (PowersEffect(cause="unmodelled_actuator", channel="p", centre=0.0, scale=1.0, order=31),
         "order: Expected `int` <= 30"),
        (TimeEffect(cause="interference_tone", shape="tone", start=T0, period=0.0),
         "period: Expected `float` >= 1e-09"),
        (TimeEffect(cause="offset_step", shape="step", start=1e308),
         "start: Expected `float` <= 1000000000000"),
        (ResponseEffect(cause="saturation", unit=FIELD, axis=3, knee=3e4), "axis: Expected `int` <= 2"),
        (ResponseEffect(cause="nonlinearity", unit=0.0, power=2), "unit: Expected `float` >= 1"),
        (ChannelEffect(cause="temperature_offset", channel="p", lag=-1.0), "lag: Expected `float` >= 0"),
    ],
    ids=lambda v: v if isinstance(v, str) else v.cause,
)  # fmt: skip
def test_a_number_that_cannot_be_is_one_line(effect: Effect, line: str, calibration: Calibration) -> None:
    """An impossible value from manual editing gives one line; division by it would crash the bridge."""
    extended = with_values(calibration, effect, np.zeros(effect.size))
    with pytest.raises(FormatError, match=re.escape(line)):
        decode_calibration(encode_calibration(extended))
