"""Estimators side by side: which is believed, and what the quiet one takes over."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import FIELD, World, calibration

from magbridge.calibration.corrector import Corrector
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.model import Calibration
from magbridge.learning.estimator import MEAN_SAMPLES, Estimator, EstimatorBank, Nuisance
from magbridge.learning.samples import LearnedTerms, Way, observe

PER_DEGREE = np.array([4.0, -3.0, 5.0])


def bank_of(known: Calibration) -> tuple[EstimatorBank, LearnedTerms, Nuisance]:
    """Return one that begins with a calibration and the IGRF as reference."""
    model, nuisance = LearnedTerms(known, ()), Nuisance(known.noise, 145.0)
    coefficients, covariance = model.coefficients(known)
    quiet = Estimator(coefficients, covariance, model.offsets, nuisance, 0.01)
    quiet.open(20.0**2)
    bank = EstimatorBank(model, quiet)
    bank.suppose()
    return bank, model, nuisance


def flown(temperature: np.ndarray, per_degree: np.ndarray) -> tuple[EstimatorBank, LearnedTerms]:
    """Learn from a world whose offset follows the temperature (n,) by so much (3,)."""
    known = calibration()
    bank, model, _ = bank_of(known)
    world, corrector = World(known, len(temperature)), Corrector(known)
    field = world.field + (temperature - temperature[0])[:, None] * per_degree
    for (x, y, z), mass, degrees in zip(
        field.tolist(), world.mass.tolist(), temperature.tolist(), strict=True
    ):
        corrector.numbers(0, (x, y, z), (mass,), 0)
        phi = model.regressors(corrector.regressors, (degrees,))
        for one in bank.all:
            one.propagate(Way(1.4, 4.0, 0.0))
            seen = observe((x, y, z), phi @ model.weights(one.coefficients), FIELD, FIELD)
            one.predict(seen.e, seen.s, model.derivative(phi, seen.by_nine))
            one.follow(seen.s)
        bank.judge(0.0)
        for one in bank.all:
            one.update(learn=one.is_informative)
    return bank, model


def test_a_warming_is_taken_over_from_the_one_that_follows_the_temperature() -> None:
    """It is believed, has found by how much, and the quiet one goes on with that."""
    warming = 12.0 * (1.0 - np.exp(-np.arange(400) / 150.0))
    bank, model = flown(warming, PER_DEGREE)
    warm = bank.all[1]
    assert bank.best is warm
    assert warm.coefficients[model.slots("sensor_temperature")] == pytest.approx(PER_DEGREE, abs=1.0)
    assert not bank.take_over(1000.0)  # the result of an alarm is far better
    assert bank.take_over(20.0)
    assert bank.best is bank.quiet is not warm
    np.testing.assert_array_equal(bank.quiet.coefficients, warm.coefficients)


def test_a_temperature_that_does_nothing_is_not_believed() -> None:
    """However much it changes."""
    bank, _ = flown(4.0 + 8.0 * np.sin(np.arange(300) / 40.0), np.zeros(3))
    assert bank.best is not bank.all[1]
    assert not bank.take_over(0.0)


def test_the_result_of_an_alarm_is_accepted_if_it_is_far_better() -> None:
    """Otherwise the selected one stays."""
    warming = 12.0 * (1.0 - np.exp(-np.arange(400) / 150.0))
    bank, _ = flown(warming, PER_DEGREE)
    nothing = np.zeros(bank.quiet.states), np.zeros((bank.quiet.states, bank.quiet.states))
    bank.explained(*nothing, 1.0)
    assert bank.best is bank.all[1]
    bank.explained(*nothing, 1000.0)
    assert bank.best is bank.quiet


def test_a_calibration_that_follows_the_temperature_is_not_supposed_to() -> None:
    """Then only the drifting one and the quiet one remain."""
    known = calibration()
    assert len(bank_of(known)[0].all) == 3
    effect = ChannelEffect(cause="temperature_offset", channel="sensor_temperature", origin=0.0)
    size = len(known.coefficients) + 3
    own = Calibration(
        parameters=known.parameters,
        terms=known.terms,
        effects=(effect,),
        coefficients=np.zeros(size),
        covariance=np.eye(size),
        noise=known.noise,
        reference=known.reference,
        method="auto",
    )
    assert len(bank_of(own)[0].all) == 2


def test_no_drift_gets_less_certain_than_the_steepest() -> None:
    """A month straight and level tells nothing, and overflows nothing."""
    drifting = bank_of(calibration())[0].all[-1]
    for _ in range(30 * 24):
        drifting.propagate(Way(5000.0, 3600.0, 0.0))
    assert 19.0 < np.sqrt(drifting.filter.covariance[drifting.slope, drifting.slope]).max() * 3600.0 < 30.0


def test_an_unobserved_level_is_kept() -> None:
    """The crustal field absorbs small changes; a significant change of the level is learned."""
    bank, _ = flown(np.full(400, 4.0), PER_DEGREE)
    quiet = bank.quiet
    learned, crust = quiet.coefficients.copy(), quiet.crust

    def level(coefficients: np.ndarray) -> float:
        return float(quiet._mean @ coefficients)

    quiet.keep_level(learned + 200.0)
    np.testing.assert_array_equal(quiet.coefficients, learned)
    published = learned + np.random.default_rng(6).normal(size=len(learned))
    quiet.keep_level(published)
    by = level(published) - level(learned)
    assert abs(by) > 0.5
    assert level(quiet.coefficients) == pytest.approx(level(published), abs=1e-6)
    share = 1.0 - (1.0 - 1.0 / MEAN_SAMPLES) ** 400  # of the mean derivative that is followed by now
    assert quiet.crust - crust == pytest.approx(by / share, rel=0.1)
