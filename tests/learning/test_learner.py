"""The bridge learns: what it says of a sample is the fit's own equation, and what it makes of many."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from magbridge.calibration.correct import Corrector
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.residual import Samples, residuals, whiten
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.learning import Learner
from magbridge.learning.nuisance import Nuisance
from magbridge.learning.observation import observe
from magbridge.records import Quality

MASS = Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0)
ORDER = full_order(1, 2)
FIELD = 50_000.0


def calibration(sigma: float = 1.0) -> Calibration:
    """Return one whose coefficients are uncertain by `sigma` nT each."""
    K = 9 * len(ORDER)
    coefficients = np.random.default_rng(3).normal(size=K) * 200.0
    return Calibration(
        parameters=(MASS,),
        terms=(Polynomial(exponents=ORDER),),
        coefficients=coefficients,
        covariance=np.eye(K) * sigma**2,
        noise=Noise(1.0),
        reference=Reference(FIELD),
        method="auto",
    )


class World:
    """A glider that yaws to and fro, pitches up and down and moves its mass, over smooth rock."""

    def __init__(self, truth: Calibration, samples: int, seed: int = 1, *, straight: bool = False) -> None:
        rng = np.random.default_rng(seed)
        k = np.arange(samples)
        leg = k // 60
        yaw = 0.6 if straight else 0.7 * leg + 0.1 * rng.normal(size=samples)
        pitch = 0.0 if straight else np.where(leg % 2, 0.45, -0.4) + 0.05 * rng.normal(size=samples)
        roll = 0.02 * rng.normal(size=samples)
        north, down = 0.4 * np.cos(yaw) + 0 * k, 0.9
        x = north * np.cos(pitch) - down * np.sin(pitch)
        z = north * np.sin(pitch) + down * np.cos(pitch)
        y = -0.4 * np.sin(yaw) * np.cos(roll) + z * np.sin(roll)
        unit = np.column_stack([x, y, z])
        unit /= np.linalg.norm(unit, axis=1)[:, None]
        self.rock = 60.0 * np.sin(k * 4.0 * 0.35 / 400.0) if straight else 60.0 * np.sin(k * 1.4 / 900.0)
        self.total = FIELD + self.rock
        self.mass = np.where(leg % 2, 0.5, -0.5) if not straight else np.zeros(samples)
        A, T = truth.matrices(self.mass[:, None])
        self.field = np.linalg.solve(A, (unit * self.total[:, None])[:, :, None])[:, :, 0] + T
        self.field += rng.normal(size=(samples, 3))
        self.where: list[tuple[float, float] | None] = [
            (49.0 + n * 1.4 / 111_000.0, -57.0) for n in range(samples)
        ]


def learn(learner: Learner, world: World, *, added: np.ndarray | None = None, quality: int = 0) -> list[int]:
    """Give the learner a world's samples; return where it doubted."""
    corrector, doubted = Corrector(learner.first), []
    field = world.field if added is None else world.field + added
    for n, reading in enumerate(field.tolist()):
        values = (float(world.mass[n]),)
        corrector.numbers(0, (reading[0], reading[1], reading[2]), values, 0)
        learner.sample(
            (n + 1) * 4_000_000,
            (reading[0], reading[1], reading[2]),
            corrector.regressors,
            values,
            quality,
            faulty=False,
            reference=FIELD,
            where=world.where[n],
            watched=(nan,),
        )
        if learner.flags:
            doubted.append(n)
    return doubted


def error_of(learned: Calibration, world: World) -> float:
    """Return the RMS error about its mean of the total field, nT, without the noise."""
    A, T = learned.matrices(world.mass[:, None])
    total = np.linalg.norm(np.matmul(A, (world.field - T)[:, :, None])[:, :, 0], axis=1)
    return float(np.std(total - world.total))


def test_one_sample_is_the_fits_own_residual() -> None:
    """Both the residual and its derivatives by the nine coefficients."""
    rng = np.random.default_rng(2)
    nine = rng.normal(size=9) * 500.0
    field = rng.normal(size=(5, 3)) * 30_000.0
    samples = Samples(field, np.full(5, FIELD), np.ones((5, 1)), np.ones(5), 48_000.0, 0.3)
    e, g = residuals(samples, nine)
    for n in range(5):
        x, y, z = field[n].tolist()
        one = observe((x, y, z), nine, 48_000.0, FIELD, 0.3)
        assert one.e == pytest.approx(e[n], rel=1e-12)
        np.testing.assert_allclose(one.by_nine, g[n], rtol=1e-9)


def test_rock_and_noise_are_stationary_along_the_track() -> None:
    """Whatever the steps: the covariance stays, and far away nothing is known."""
    nuisance = Nuisance(Noise(2.0, autocorrelation=0.9, interval=4.0, white=0.25), 100.0, 800.0)
    F, Q = nuisance.over(70.0, 12.0)
    np.testing.assert_allclose(F @ nuisance.initial @ F.T + Q, nuisance.initial, atol=1e-9)
    first, second = nuisance.over(30.0, 5.0)[0], nuisance.over(40.0, 7.0)[0]
    np.testing.assert_allclose(second @ first, F, atol=1e-12)
    assert np.abs(nuisance.over(1e6, 1e6)[0]).max() < 1e-9
    assert nuisance.initial[2, 2] + nuisance.white == pytest.approx(4.0)
    # the slow part forgets as the fit's noise does
    assert F[2, 2] == pytest.approx(0.9 ** (12.0 / 4.0))
    assert np.isfinite(whiten(np.ones(3), np.ones(3), 0.9, 0.25)).all()


def test_a_changed_offset_is_learned_and_published() -> None:
    """The published one is as good as the noise lets it be; its id and its history are its own."""
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
    """Nor is anything doubted."""
    known = calibration()
    learner = Learner(known)
    assert learn(learner, World(known, 1500)) == []
    assert learner.calibration is known
    assert learner.samples > 500


def test_rock_is_not_learned_on_a_straight_track() -> None:
    """The change is within a fraction of what was not known of the offset at this power-on."""
    known = calibration()
    learner = Learner(known)
    doubted = learn(learner, World(known, 1500, straight=True))
    moved = learner.learned().coefficients - known.coefficients
    sigma = np.sqrt(np.diag(known.covariance))
    sigma[6:9] = np.hypot(sigma[6:9], 20.0)
    assert learner.calibration is known
    assert np.abs(moved / sigma).max() < 1.0
    assert doubted == []


def test_a_step_is_doubted_named_and_ends_when_learned() -> None:
    """Sigma grows at once to what is seen, and is small again once it is learned."""
    known = calibration()
    learner = Learner(known)
    added = np.zeros((2400, 3))
    added[1300:] = [15.0, 15.0, -15.0]
    doubted = learn(learner, World(known, 2400), added=added)
    assert 1300 <= doubted[0] < 1320
    texts = [notice.text for notice in learner.notices]
    assert "offset step" in next(text for text in texts if text.startswith("unexplained"))
    assert learner.flags == 0
    assert learner.variance == 0.0
    shifted = World(known, 2400)
    shifted.field += added[-1]
    assert error_of(learner.calibration, shifted) < 1.6


def test_sigma_covers_what_is_not_explained() -> None:
    """Frozen, nothing is learned, so the doubt stands until someone acknowledges it."""
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


def test_flagged_samples_teach_nothing() -> None:
    """Nor do those without a position."""
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
    """And accepting makes what was learned the first."""
    known = calibration()
    world, added = World(known, 1000), np.tile([12.0, -9.0, 14.0], (1000, 1))
    learner = Learner(known)
    learn(learner, world, added=added)
    assert learner.calibration is not known
    learner.forget()
    assert learner.calibration is known
    assert learner.samples == 0
    learn(learner, world, added=added)
    learner.accept()
    assert learner.first is learner.calibration
    assert learner.first is not known


def test_a_worse_calibration_is_rolled_back() -> None:
    """What was published is taken back when the offset goes back to what it was."""
    known = calibration()
    added = np.zeros((3000, 3))
    added[:700] = [12.0, -9.0, 14.0]
    learner = Learner(known)
    learn(learner, World(known, 3000), added=added)
    world = World(known, 3000)
    assert any(notice.text.startswith(("learned", "accepted")) for notice in learner.notices)
    assert error_of(learner.calibration, world) < 1.5


def test_no_more_than_max_rate_is_learned_from() -> None:
    """At 0.25 Hz every sample counts; at a hundredth of that, few do."""
    known = calibration()
    counts = []
    for rate in (1.0, 0.025):
        learner = Learner(known, max_rate=rate)
        learn(learner, World(known, 300))
        counts.append(learner.samples)
    assert counts[0] > 5 * counts[1] > 0
