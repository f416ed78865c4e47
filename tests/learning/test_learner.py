"""Test in-flight calibration: the equation of a sample equals the fit's; results of many samples."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import FIELD, World, calibration, error_of, grid_of, learn

from magbridge.calibration.model import Calibration, Noise
from magbridge.estimation.noise import whiten
from magbridge.estimation.residual import ResidualSamples, residuals
from magbridge.learning import Learner
from magbridge.learning.estimator import Nuisance
from magbridge.learning.samples import observe
from magbridge.records import Quality


def test_one_sample_is_the_fits_own_residual() -> None:
    """Both the residual and its derivatives by the nine coefficients."""
    rng = np.random.default_rng(2)
    nine = rng.normal(size=9) * 500.0
    field = rng.normal(size=(5, 3)) * 30_000.0
    samples = ResidualSamples(field, np.full(5, FIELD), np.ones((5, 1)), np.ones(5), 48_000.0)
    e, g = residuals(samples, nine)
    for n in range(5):
        x, y, z = field[n].tolist()
        one = observe((x, y, z), nine, 48_000.0, FIELD)
        assert one.e == pytest.approx(e[n], rel=1e-12)
        np.testing.assert_allclose(one.by_nine, g[n], rtol=1e-9)


def test_crustal_field_and_noise_are_stationary_along_the_track() -> None:
    """For any step lengths, the covariance is stationary, and distant fields are independent."""
    nuisance = Nuisance(Noise(2.0, autocorrelation=0.9, interval=4.0, white=0.25), 100.0, 50.0, 800.0)
    F, Q = nuisance.transition(70.0, 12.0)
    np.testing.assert_allclose(F @ nuisance.initial @ F.T + Q, nuisance.initial, atol=1e-9)
    first, second = nuisance.transition(30.0, 5.0)[0], nuisance.transition(40.0, 7.0)[0]
    np.testing.assert_allclose(second @ first, F, atol=1e-12)
    far = nuisance.transition(1e6, 1e6)[0]
    np.testing.assert_allclose(far, np.diag([0.0, 0.0, 0.0, 1.0]), atol=1e-9)  # but the level
    assert nuisance.initial[2, 2] + nuisance.white_variance == pytest.approx(4.0)
    # the slow part forgets as the fit's noise does
    assert F[2, 2] == pytest.approx(0.9 ** (12.0 / 4.0))
    assert np.isfinite(whiten(np.ones(3), np.ones(3), 0.9, 0.25)).all()


def test_it_learns_from_samples_that_the_next_reading_confirms() -> None:
    """Not from slopes that lag behind, as of channels that are sampled in turn."""
    known, n = calibration(), 400
    world = World(known, n)
    lag = np.zeros((n, 3))
    lag[1:] = 0.01 * np.diff(world.field, axis=0)
    exact, settled, lagging = Learner(known), Learner(known), Learner(known)
    learn(exact, world)
    learn(settled, world, added=lag, settled=world.field)
    learn(lagging, world, added=lag)
    np.testing.assert_array_equal(settled.learned().coefficients, exact.learned().coefficients)
    assert np.abs(lagging.learned().coefficients - exact.learned().coefficients).max() > 1.0


def test_what_waits_while_learning_is_off_is_settled_by_its_own_next_reading() -> None:
    known = calibration()
    world, found = World(known, 100), []
    for by in (0.0, 300.0):
        learner, settled = Learner(known), world.field.copy()
        settled[61:71] += by  # of readings that came while it was off

        def switch(k: int, learner: Learner = learner) -> None:
            learner.enabled = not 60 <= k < 70

        learn(learner, world, settled=settled, seen=switch)
        found.append(learner.learned().coefficients)
    np.testing.assert_array_equal(found[0], found[1])


def test_a_changed_offset_is_learned_and_published() -> None:
    """The published calibration is as good as the noise allows, with its own id and history."""
    known, world = calibration(), None
    world = World(known, 1500)
    learner = Learner(known)
    learn(learner, world, added=np.tile([12.0, -9.0, 14.0], (1500, 1)))
    assert learner.calibration is not known
    shifted = World(known, 1500)
    shifted.field += np.array([12.0, -9.0, 14.0])
    assert error_of(known, shifted) > 5.0
    assert error_of(learner.calibration, shifted) < 1.3
    assert learner.calibration.method == "auto, learned"
    assert any(name.startswith("calibration ") for name in learner.calibration.inputs)


def test_nothing_is_published_where_nothing_has_changed() -> None:
    """Without a change, the learner publishes nothing and raises no alarm."""
    known = calibration()
    learner = Learner(known)
    assert learn(learner, World(known, 1500)) == []
    assert learner.calibration is known
    assert learner.samples > 500


def test_crustal_field_is_not_learned_on_a_straight_track() -> None:
    """The change is within a fraction of the unknown offset of this power-on."""
    known = calibration()
    learner = Learner(known)
    doubted = learn(learner, World(known, 1500, straight=True))
    moved = learner.learned().coefficients - known.coefficients
    sigma = np.sqrt(np.diag(known.covariance))
    sigma[6:9] = np.hypot(sigma[6:9], 20.0)
    assert learner.calibration is known
    assert np.abs(moved / sigma).max() < 1.0
    assert doubted == []


def test_a_step_raises_an_alarm_with_a_name_that_ends_when_learned() -> None:
    """Sigma grows at once to the seen error, and is small again after it is learned."""
    known = calibration()
    learner = Learner(known)
    added = np.zeros((2400, 3))
    added[1300:] = [15.0, 15.0, -15.0]
    doubted = learn(learner, World(known, 2400), added=added)
    assert 1300 <= doubted[0] < 1320
    texts = [notice.text for notice in learner.notices if "explained" in notice.text]
    assert len(texts) == 2
    assert texts[0].startswith("unexplained: ")
    assert "offset step" in texts[0]
    assert texts[1].startswith("explained again: offset step, learned ")
    assert learner.flags == 0
    assert learner.variance == 0.0
    shifted = World(known, 2400)
    shifted.field += added[-1]
    assert error_of(learner.calibration, shifted) < 1.6


def test_a_sample_that_waits_is_not_kept_across_a_power_on() -> None:
    """Earlier measurements have other offsets and are discarded."""
    known, learners = calibration(), (Learner(calibration()), Learner(calibration()))
    for learner, before in zip(learners, (0.0, 4.0), strict=True):

        def power(n: int, learner: Learner = learner) -> None:
            if n == 99:
                learner.restarted()

        world = World(known, 105)
        world.field[99] += before
        learn(learner, world, seen=power)
    one, other = (learner.learned().coefficients for learner in learners)
    np.testing.assert_array_equal(one, other)


def test_sigma_covers_what_is_not_explained() -> None:
    """Frozen, nothing is learned, so the alarm stays until a user acknowledges it."""
    known = calibration()
    learner = Learner(known)
    learner.frozen = True
    added = np.zeros((900, 3))
    added[600:] = [0.0, 0.0, 40.0]
    learn(learner, World(known, 900), added=added)
    assert learner.flags == Quality.UNEXPLAINED
    assert learner.samples == 0
    assert 15.0 < learner.variance**0.5 < 120.0
    learner.accept()
    assert (learner.flags, learner.variance) == (0, 0.0)
    assert learner.calibration is known


def test_a_change_that_ended_without_a_cause_may_have_moved_the_offsets() -> None:
    """Learning that starts again expects a change of the size that the alarm had."""
    known = calibration()
    added = np.zeros((700, 3))
    added[100:140] = np.random.default_rng(1).normal(0.0, 60.0, (40, 3))  # disturbance of no known form
    learner = Learner(known)
    sizes: list[float] = []
    learn(learner, World(known, 700), added=added, seen=lambda _: sizes.append(learner.state.size))
    assert [notice.text for notice in learner.notices][1:] == ["explained again: gone"]
    learner._restart_judged()
    before = np.diag(known.covariance)[learner._model.offsets]
    opened = np.diag(learner.learned().covariance)[learner._model.offsets] - before
    size = next(size for size in reversed(sizes) if size > 0.0)
    np.testing.assert_allclose(opened, 20.0**2 + size**2, rtol=1e-6)


def test_flagged_samples_teach_nothing() -> None:
    """Neither flagged samples nor samples without a position update the learner."""
    known = calibration()
    for quality in (Quality.MOVING, Quality.STALE_TELEMETRY, Quality.SATURATED, Quality.LATE_JOIN):
        learner = Learner(known)
        learn(learner, World(known, 100), quality=int(quality))
        assert learner.samples == 0
    learner, world = Learner(known), World(known, 2000)
    world.where = [None] * 2000
    learn(learner, world)
    assert learner.samples == 0
    assert [notice.text for notice in learner.notices] == ["learning: an hour without a sample to learn from"]


def test_forgetting_goes_back_to_the_first() -> None:
    """Accepting makes the learned calibration the first."""
    known = calibration()
    world, added = World(known, 1000), np.tile([12.0, -9.0, 14.0], (1000, 1))
    learner = Learner(known)
    learn(learner, world, added=added)
    assert learner.calibration is not known
    learner.forget()
    assert learner.calibration is known
    assert learner.samples == 0
    learn(learner, world, added=added)
    first, published, _ = learner.state.rms
    assert published < first
    learner.accept()
    assert learner.first is learner.calibration
    assert learner.first is not known
    assert learner.state.rms[:2] == (published, published)  # its errors are now the first's


def test_forgetting_and_accepting_come_before_any_sample_too() -> None:
    """An operator may ask for both as soon as the bridge is up."""
    known = calibration()
    learner = Learner(known)
    learner.accept()
    learner.forget()
    assert learner.calibration is known
    assert [notice.text for notice in learner.notices] == ["learning: all forgotten"]


def test_a_worse_calibration_is_rolled_back() -> None:
    """The published change is withdrawn when the offset returns to its value."""
    known = calibration()
    added = np.zeros((3000, 3))
    added[:700] = [12.0, -9.0, 14.0]
    learner = Learner(known)
    learn(learner, World(known, 3000), added=added)
    world = World(known, 3000)
    assert any(notice.text.startswith(("learned", "accepted")) for notice in learner.notices)
    assert error_of(learner.calibration, world) < 1.5


def test_a_map_tells_the_level_too() -> None:
    """With the IGRF alone, the learned calibration may have any level; with a map it has the map's."""
    known = calibration(30.0)
    world = World(vehicle_off(known), 1500)
    errors = {}
    for name, grid, spread in (("igrf", None, 145.0), ("map", grid_of(1.0), 20.0)):
        learner = Learner(known, grid=grid, spread=spread)
        learn(learner, world)
        A, T = learner.learned().matrices(world.mass[:, None])
        total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
        errors[name] = abs(float(np.mean(total - world.total)))
    assert errors["map"] < 12.0
    assert errors["map"] < errors["igrf"] + 5.0


def vehicle_off(known: Calibration) -> Calibration:
    """Return a calibration with errors drawn from the known one's sigma."""
    off = 30.0 * np.random.default_rng(8).normal(size=len(known.coefficients))
    return replace(known, coefficients=known.coefficients + off)


def test_a_pumps_current_becomes_a_term() -> None:
    """The learned calibration carries it, and needs its telemetry."""
    known, n = calibration(), 1500
    current = np.where(np.arange(n) % 50 < 12, 2.0, 0.0)
    added = current[:, None] * np.array([8.0, -6.0, 9.0]) * (np.arange(n) > 500)[:, None]
    learner = Learner(known, currents=("pump_current",))
    learn(learner, World(known, n), added=added, watched=np.column_stack([np.full(n, 4.0), current]))
    assert learner.calibration.channels == ("battpos", "pump_current")
    assert learner.calibration.coefficients[-3:] == pytest.approx([8.0, -6.0, 9.0], abs=1.5)
    assert any(notice.text.startswith("unexplained") for notice in learner.notices)


def test_a_temperature_becomes_a_term() -> None:
    """The coefficients that it has stay, for any offset that is learned meanwhile."""
    known, n = calibration(), 2400
    temperature = -10.0 + 12.0 / (1.0 + np.exp(-(np.arange(n) - 1200.0) / 150.0))
    per_degree = np.array([4.0, -3.0, 5.0])
    learner = Learner(known)
    added = (temperature - temperature[0])[:, None] * per_degree
    learn(learner, World(known, n), added=added, watched=temperature[:, None])
    shifted = World(known, n)
    assert "sensor_temperature" in learner.calibration.channels
    shifted.field += added[-1]
    last = learner.calibration.without_effects()
    coefficients = last.coefficients.copy()
    coefficients[6:9] += learner.calibration.coefficients[-3:] * 12.0
    assert error_of(replace(last, coefficients=coefficients), shifted) < 2.5


def test_no_more_than_max_rate_is_learned_from() -> None:
    """At 0.25 Hz every sample counts; at a hundredth of that, few do."""
    known = calibration()
    counts = []
    for rate in (1.0, 0.025):
        learner = Learner(known, max_rate=rate)
        learn(learner, World(known, 300))
        counts.append(learner.samples)
    assert counts[0] > 5 * counts[1] > 0
