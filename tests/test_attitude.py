"""What of the total field follows the attitude: a wrong gain or offset is seen on one course, rock is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.health import Attitude
from magbridge.records import Quality

EARTH = np.array([18_000.0, -5_000.0, 48_000.0])


def flown(n: int, seed: int, every: float = 4.0) -> FloatArray:
    """The Earth's field in body axes (n, 3) along one course, of a vehicle that rolls and yaws a little."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-every / 15.0)
    about = [lfilter([(1.0 - keep**2) ** 0.5], [1.0, -keep], rng.normal(0.0, s, n)) for s in (3.0, 1.0, 2.0)]
    dive = 24.0 * np.sign(np.sin(2.0 * np.pi * every * np.arange(n) / 1200.0))
    angles = np.column_stack([50.0 + about[0], dive + about[1], about[2]])
    return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).inv().apply(EARTH))


def judge(field: FloatArray, every: float = 4.0, quality: int = 0) -> tuple[FloatArray, Attitude]:
    """Return the sigma (n,), nT, that is added, and the judge."""
    one = Attitude()
    added = [
        one.check(round(1e6 * every * k), x, y, z, (x * x + y * y + z * z) ** 0.5, 2.0, quality) ** 0.5
        for k, (x, y, z) in enumerate(field.tolist())
    ]
    return np.array(added), one


def noisy(field: FloatArray, seed: int, rock: float = 0.0, every: float = 4.0) -> FloatArray:
    """Noise of 1 nT, and `rock` nT that takes ten minutes from crest to crest."""
    along = rock * np.sin(2.0 * np.pi * every * np.arange(len(field)) / 600.0)
    scaled = field * (1.0 + along / np.linalg.norm(field, axis=1))[:, None]
    return scaled + np.random.default_rng(seed).normal(0.0, 1.0, field.shape)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("gain", [0.02, -0.01])
def test_a_gain_of_one_axis_is_seen_on_one_course(axis: int, gain: float) -> None:
    """What is off is within three of the sigmas that it adds, which are not much larger."""
    true = flown(1200, 3)
    faulty = noisy(true, 4, rock=30.0)
    faulty[:, axis] *= 1.0 + gain
    added, one = judge(faulty)
    field = np.linalg.norm(true, axis=1)
    follows = np.abs(gain * true[:, axis] ** 2 / field)[400:]
    assert (added[400:] > 0.0).all()
    assert np.mean(follows > 3.0 * np.hypot(added[400:], 2.0**0.5)) < 0.003
    assert np.median(added[400:]) < 1.5 * np.median(follows)
    assert one.notices == ["field follows the attitude: gain, offset or a mass wrong"]


def test_an_offset_on_the_way_is_seen() -> None:
    faulty = noisy(flown(2400, 3), 4)
    faulty[600:, 1] += 150.0
    added, one = judge(faulty)
    assert not added[:600].any()
    assert added[2000:].min() > 0.0
    assert len(one.notices) == 1


@pytest.mark.parametrize("rock", [0.0, 100.0])
@pytest.mark.parametrize("every", [1.0, 4.0])
def test_rock_and_noise_do_not_follow_the_attitude(rock: float, every: float) -> None:
    for seed in range(3):
        added, one = judge(noisy(flown(4000, seed, every), seed + 10, rock, every), every)
        assert not added.any()
        assert one.notices == []


def test_what_is_over_is_forgotten_within_hours() -> None:
    faulty = noisy(flown(4000, 3), 4)
    faulty[:1000, 1] *= 1.02
    added, _ = judge(faulty)
    assert (added[600:1000] > 0.0).all()
    assert (added[1000:2000] > 0.0).all()
    assert not added[3900:].any()


def test_another_calibration_is_judged_anew() -> None:
    faulty = noisy(flown(1000, 3), 4)
    faulty[:, 1] *= 1.02
    _, one = judge(faulty)
    x, y, z = faulty[-1].tolist()
    total = float(np.linalg.norm(faulty[-1]))
    assert one.check(4_000_000_000, x, y, z, total, 2.0, 0) > 0.0
    one.forget()
    assert one.check(4_004_000_000, x, y, z, total, 2.0, 0) == 0.0


def test_samples_that_are_doubtful_teach_nothing() -> None:
    faulty = noisy(flown(1000, 3), 4)
    faulty[:, 1] *= 1.02
    added, one = judge(faulty, quality=int(Quality.MOVING))
    assert not added.any()
    assert one.notices == []
    assert one.check(1, 0.0, 0.0, 0.0, 0.0, 2.0, 0) == 0.0
