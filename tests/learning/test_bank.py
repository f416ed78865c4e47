"""Test the bank of estimators: the selection, and what the baseline takes from the selected estimator."""

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds import FIELD, MASS, World, calibration, error_of, learn

from magbridge.calibration.correct import Corrector
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.model import Calibration, Noise
from magbridge.learning import Learner
from magbridge.learning.alarms import (
    LOG_RATIO_PER_CAUSE,
    MIN_GROWTH,
    SILENT_SAMPLES,
    AlarmState,
    LearningAlarm,
)
from magbridge.learning.estimator import (
    FIRST_FIT_SAMPLES,
    MEAN_SAMPLES,
    Estimator,
    EstimatorBank,
    Nuisance,
    class_prior,
)
from magbridge.learning.judge import CANDIDATE, FIRST, PUBLISHED, Coverage, Judge
from magbridge.learning.samples import LearnedTerms, Way, observe

PER_DEGREE = np.array([4.0, -3.0, 5.0])


def bank_of(known: Calibration) -> tuple[EstimatorBank, LearnedTerms, Nuisance]:
    """Return a bank that begins with a calibration and the IGRF as reference."""
    model, nuisance = LearnedTerms(known, ()), Nuisance(known.noise, 145.0)
    coefficients, covariance = model.coefficients(known)
    quiet = Estimator(coefficients, covariance, model.offsets, nuisance, 0.01)
    quiet.open(20.0**2)
    bank = EstimatorBank(model, quiet)
    bank.suppose()
    return bank, model, nuisance


def flown(temperature: np.ndarray, per_degree: np.ndarray) -> tuple[EstimatorBank, LearnedTerms]:
    """Process a world whose offset follows the temperature (n,) with the coefficients (3,)."""
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
    """The bank selects this estimator, which has found the coefficient; the baseline takes it over."""
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
    """A temperature without effect is not selected, however much it changes."""
    bank, _ = flown(4.0 + 8.0 * np.sin(np.arange(300) / 40.0), np.zeros(3))
    assert bank.best is not bank.all[1]
    assert not bank.take_over(0.0)


def test_the_result_of_an_alarm_is_accepted_if_it_is_far_better() -> None:
    """Otherwise the bank keeps the selected estimator."""
    warming = 12.0 * (1.0 - np.exp(-np.arange(400) / 150.0))
    bank, _ = flown(warming, PER_DEGREE)
    nothing = np.zeros(bank.quiet.states), np.zeros((bank.quiet.states, bank.quiet.states))
    bank.explained(*nothing, 1.0)
    assert bank.best is bank.all[1]
    bank.explained(*nothing, 1000.0)
    assert bank.best is bank.quiet


def test_an_explained_cause_moves_the_baseline_and_its_covariance_only() -> None:
    bank, _, _ = bank_of(calibration())
    others = [(one.coefficients.copy(), one.covariance.copy()) for one in bank.all[1:]]
    before, spread = bank.quiet.coefficients.copy(), bank.quiet.covariance.copy()
    n = len(bank.quiet.filter.mean)
    step, root = np.random.default_rng(2).normal(size=n), np.eye(n) * 0.3
    bank.explained(step, root @ root.T, 20.0)
    size = len(before)
    np.testing.assert_allclose(bank.quiet.coefficients - before, step[:size])
    np.testing.assert_allclose(bank.quiet.covariance - spread, 0.09 * np.eye(size), atol=1e-6)
    for one, (mean, covariance) in zip(bank.all[1:], others, strict=True):
        np.testing.assert_array_equal(one.coefficients, mean)
        np.testing.assert_array_equal(one.covariance, covariance)


def test_a_calibration_that_follows_the_temperature_is_not_supposed_to() -> None:
    """Then only the drifting estimator and the baseline remain."""
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


# ---- Which calibration predicts better: only samples that come after what was learned decide -------------


LEG_SAMPLES = 200
STEP_M, STEP_S = 1.4, 4.0


def judged(hours: float, first: float, candidate: float, pulses: float = 0.0) -> Judge:
    """Return the comparison after a glider's legs, with errors (nT) that change sign at every dive and climb.

    `pulses` (nT) are added in two of every ten minutes, for both calibrations.
    """
    rng = np.random.default_rng(5)
    nuisance = Nuisance(Noise(1.0), 145.0)
    judge, F = Judge(nuisance), nuisance.transition(STEP_M, STEP_S)[0]
    for k in range(int(hours * 3600.0 / STEP_S)):
        sign = (-1.0) ** (k // LEG_SAMPLES)
        crust = 7.0 * np.sin(STEP_M * k / 500.0)
        seen = crust + rng.normal() + pulses * (k * STEP_S % 600.0 < 120.0)
        judge.is_due(STEP_M, STEP_S, np.array([0.4 * sign, 0.0, 0.9]))
        residuals = seen + first * sign, seen + first * sign, seen + candidate * sign
        judge.judge(F, residuals, 1.0)
    return judge


def test_a_candidate_with_smaller_errors_is_adopted_after_some_turns() -> None:
    assert not judged(0.5, 3.0, 0.0).adopt()
    assert judged(2.0, 3.0, 0.0).adopt()
    assert not judged(2.0, 3.0, 0.0).roll_back


def test_a_candidate_with_errors_of_its_own_is_not_adopted() -> None:
    """Not if its errors are as large as those of the first, and it is rolled back if they are larger."""
    equal = judged(3.0, 1.0, -1.0)
    assert (equal.adopt(), equal.roll_back) == (False, False)
    worse = judged(3.0, 0.0, 3.0)
    assert (worse.adopt(), worse.roll_back) == (False, True)
    assert worse.mean_square[FIRST] == worse.mean_square[PUBLISHED] < worse.mean_square[CANDIDATE]


def test_an_expected_change_is_adopted_after_one_turn() -> None:
    """An alarm whose cause explains the samples gives such an expected change."""
    judge = judged(0.3, 3.0, 0.0)
    assert judge.adopt(expected=True)
    assert not judge.adopt()
    assert not judged(0.3, 0.0, 3.0).adopt(expected=True)


def test_pulses_that_no_calibration_explains_decide_nothing() -> None:
    judge = judged(3.0, 0.3, -0.3, pulses=20.0)
    assert (judge.adopt(), judge.roll_back) == (False, False)


def test_a_new_candidate_begins_with_the_level_of_the_last() -> None:
    judge = judged(2.0, 3.0, 0.0)
    better = judge.better
    judge.replace(CANDIDATE, 50.0, 1.0)
    F = np.eye(4)
    judge.judge(F, (0.0, 0.0, 50.0), 1.0)
    assert abs(judge.better - better) < 20.0  # 2,500 if the level counted


def test_a_change_is_significant_only_if_it_is_known_at_all_attitudes() -> None:
    """An offset that is known along two axes only is not significant."""
    coverage, covariance = Coverage(3), np.diag([1.0, 1.0, 400.0])
    change = np.array([10.0, 10.0, 0.0])
    for direction in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        unit = np.array(direction)
        assert not coverage.is_significant(change, covariance)
        coverage.add(unit, unit)
    assert coverage.is_significant(change, covariance)
    assert not coverage.is_significant(0.1 * change, covariance)
    for direction in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)):
        coverage.add(np.array(direction), np.array(direction))
    assert not coverage.is_significant(change, covariance)


# ---- The state of an alarm: its reports, and when its cause is learned -----------------------------------


def alarm(strength: float, *causes: str) -> LearningAlarm:
    return LearningAlarm(causes, ("",) * len(causes), since=0.0, size=5.0, strength=strength)


def standing(*alarms: LearningAlarm, telling: int = 0) -> AlarmState:
    """Return the state after these alarms, then `telling` informative and as many uninformative samples."""
    one = AlarmState()
    for each in alarms:
        one.update(each)
    return counted(one, telling)


def counted(one: AlarmState, telling: int, error: float = 0.0) -> AlarmState:
    """Return the state after informative samples with an `error` (nT) and as many uninformative ones."""
    for _ in range(telling):
        one.count(error, 1.0, informative=True)
        one.count(0.0, 1.0, informative=False)
    return one


def test_it_is_learned_sooner_the_fewer_causes_fit() -> None:
    """Each further cause requires more evidence."""
    two = "offset_drift", "temperature_offset"
    first = alarm(20.0, *two)
    assert not standing(first, alarm(20.1 + MIN_GROWTH, *two)).is_certain
    assert standing(first, alarm(20.1 + MIN_GROWTH + LOG_RATIO_PER_CAUSE, *two)).is_certain
    assert standing(first, alarm(20.1 + MIN_GROWTH, "offset_drift")).is_certain
    assert standing(first).update(alarm(22.0, "offset_drift")) == ""  # its cause is reported at its end


def relapsed() -> AlarmState:
    """Return a state whose cause was learned by mistake: errors of 30 nT occurred."""
    one = standing(alarm(20.0, "offset_step"))
    one.try_cause()
    assert one.variance == 25.0  # until it is confirmed
    assert one.confirm()
    counted(one, SILENT_SAMPLES - 1, 30.0)
    assert one.update(alarm(19.0, "offset_drift")) == "unexplained still: 5 nT, offset drift"
    return one


def test_a_learned_change_with_another_alarm_was_mistaken() -> None:
    """The alarm stays the same, sigma includes the seen error, and the next threshold is higher."""
    one = relapsed()
    assert (one.relapses, one.alarm and one.alarm.since) == (1, 0.0)
    assert 28.0 < one.variance**0.5 < 30.0
    assert one.update(alarm(19.0 + 2 * MIN_GROWTH, "offset_step")) == ""
    assert not one.is_certain
    one.update(alarm(20.0 + 4 * MIN_GROWTH, "offset_step"))
    assert one.is_certain


def test_a_relapsed_alarm_ends_when_the_learned_change_has_explained_many_samples() -> None:
    """Without a message before; a significant error restarts its count."""
    one = relapsed()
    one.try_cause()
    assert not one.confirm()
    assert one.is_tried
    assert not one.is_certain
    counted(one, SILENT_SAMPLES, 0.0)
    counted(one, 1, 5.0)
    assert not one.is_silent
    assert one.flags
    assert counted(one, SILENT_SAMPLES + 1).is_silent


def test_the_next_alarm_after_a_long_time_is_another() -> None:
    """The learned change has explained the data, so it was not a mistake."""
    one = standing(alarm(20.0, "offset_step"))
    one.try_cause()
    one.confirm()
    counted(one, SILENT_SAMPLES + 1)
    assert one.update(alarm(19.0, "offset_drift")) == "unexplained: 5 nT, offset drift"
    assert one.relapses == 0
    one.mark_mistaken()  # rolled back meanwhile: on trial
    assert (one.relapses, one.is_tried) == (1, True)


# ---- The start ---------------------------------------------------------------------------------------------


HARD_IRON = np.array([2500.0, -1800.0, 3000.0])


def vehicle() -> Calibration:
    """Return a vehicle with thousands of nanotesla of hard iron."""
    known = calibration()
    coefficients = known.coefficients.copy()
    coefficients[6:9] += HARD_IRON
    return replace(known, coefficients=coefficients)


def test_a_vehicle_without_a_calibration_gets_one() -> None:
    """The error without bias approaches the noise, and sigma includes the unobservable bias."""
    world = World(vehicle(), 2100)
    learner = Learner(class_prior((MASS,), FIELD))
    assert learner.calibration.method == "none"
    learn(learner, world)
    learned = learner.calibration
    assert re.fullmatch(r"learned [0-9a-f]{8} from nothing", learner.notices[0].text)
    assert learned.method == "learned"
    assert error_of(learned, world) < 1.5
    assert 0.8 < learned.noise.sensor < 1.2
    A, T = learned.matrices(world.mass[:, None])
    total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
    assert abs(np.mean(total - world.total)) < 2.0 * 145.0


def test_no_way_that_is_flown_tells_the_level() -> None:
    """Some crustal fields are larger than a survey: after 20 km they are as unknown as at first."""
    world, learner = World(vehicle(), 5000), Learner(class_prior((MASS,), FIELD))
    learn(learner, world)
    x, y, z = world.field[-1].tolist()
    (_, sigma, *_), _ = Corrector(learner.calibration).numbers(0, (x, y, z), (float(world.mass[-1]),), 0)
    assert 0.9 * 145.0 < sigma < 2.0 * 145.0
    assert learner.calibration.reference.level_sigma == pytest.approx(sigma, rel=0.02)


def test_nothing_is_published_before_all_samples_were_fitted() -> None:
    """A filter that is linearised at the prior of the class may predict well with a large error."""
    world, learner = World(vehicle(), 60), Learner(class_prior((MASS,), FIELD))
    published = []
    learn(learner, world, seen=lambda _: published.append(learner.calibration.method))
    assert "learned" not in published[:FIRST_FIT_SAMPLES]


def test_a_jump_that_a_young_calibration_made_is_over_with_the_next_fit() -> None:
    """A field that is right again is not flagged for hours."""
    world, learner = World(vehicle(), 700), Learner(class_prior((MASS,), FIELD))
    renewed: dict[Calibration, bool] = {}

    def seen(_: int) -> None:
        renewed.setdefault(learner.calibration, learner.renewed)

    learn(learner, world, seen=seen)
    values = list(renewed.values())
    assert values.count(False) >= 4  # nothing, published, and fitted again at 128, 256 and 512 samples
    assert True in values


def test_what_was_learned_from_nothing_can_be_forgotten() -> None:
    """After the reset, the learner begins without a calibration again."""
    learner = Learner(class_prior((MASS,), FIELD))
    learn(learner, World(vehicle(), 300))
    assert learner.calibration.method == "learned"
    learner.forget()
    assert learner.calibration.method == "none"
    assert learner.samples == 0
    assert learner.learned().level == ()  # of no sample, not NaN


def test_a_class_is_as_unknown_as_physics_lets_it_be() -> None:
    """Thousands of nanotesla of hard iron, a percent of soft iron, and less with every power."""
    prior = class_prior((MASS,), FIELD)
    sigma = np.sqrt(np.diag(prior.covariance)).reshape(-1, 9)
    assert 3000.0 < sigma[0, 6] < 6000.0
    assert 500.0 < sigma[0, 0] < 4000.0
    assert sigma[1, 6] > sigma[2, 6] > sigma[3, 6]


def test_the_level_that_is_kept_is_as_unsure_as_it_differs_from_what_was_learned() -> None:
    """The published field keeps its first level; its sigma spans both."""
    learner = Learner(class_prior((MASS,), FIELD))
    learn(learner, World(vehicle(), 300))
    publication, best = learner._publication, learner._knowledge.bank.best
    publication.coefficients = best.coefficients.copy()
    publication.coefficients[6:9] += 300.0
    made = publication.made(best, 300, learner.calibration.noise)
    coefficients, covariance = learner._model.coefficients(made)
    by = float(best._mean @ (coefficients - best.coefficients))
    assert abs(by) > 20.0
    more = covariance - best.covariance
    assert best._mean @ more @ best._mean == pytest.approx(by * by)
