"""What turns do to the total field: rock is left alone, what depends on the attitude is seen."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.arrays import BoolArray, FloatArray
from magbridge.health.turns import ALARM, LEAST, Turns
from magbridge.records import Quality

FIELD, SIGMA = 52_000.0, 1.5
LEG = 120


class Dives:
    """Six hours at 0.25 Hz of a glider that dives and climbs, eight minutes each, and turns at times."""

    def __init__(self, seed: int = 1, rate: float = 0.02) -> None:
        rng = np.random.default_rng(seed)
        n = 5400
        self.time = 4.0 * np.arange(n)
        leg = np.arange(n) // LEG
        pitch = np.where(leg % 2, 0.5, -0.3) + rng.normal(0.0, 0.02, n)
        heading = np.where(leg // 8 % 2, 1.5, -1.5) + rng.normal(0.0, 0.02, n)
        steep = np.stack([0.35 * np.cos(heading), -0.35 * np.sin(heading), np.full(n, 0.94)], axis=1)
        c, s = np.cos(pitch), np.sin(pitch)
        self.u = np.stack(
            [c * steep[:, 0] - s * steep[:, 2], steep[:, 1], s * steep[:, 0] + c * steep[:, 2]], axis=1
        )
        self.u /= np.linalg.norm(self.u, axis=1)[:, None]
        length = 300.0
        self.rock = np.sqrt(2.0) * rate * length * np.sin(self.time / length + rng.uniform(0.0, 6.0))
        self.noise = rng.normal(0.0, SIGMA, n)
        moving = np.arange(n) % LEG < 10
        self.quality = np.where(moving, int(Quality.MOVING), 0)
        self.steady = ~moving

    def judge(self, error: FloatArray, turns: Turns | None = None) -> tuple[FloatArray, Turns]:
        """Return sigma (n,) where the field is off by `error` (n,), nT."""
        turns = turns or Turns()
        total = FIELD + self.rock + self.noise + error
        sigma = [
            (SIGMA**2 + turns.check(round(t * 1e6), F * x, F * y, F * z, F, SIGMA**2, q)) ** 0.5
            for t, (x, y, z), F, q in zip(
                self.time.tolist(), self.u.tolist(), total.tolist(), self.quality.tolist(), strict=True
            )
        ]
        return np.array(sigma), turns


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.3])
def test_rock_is_left_alone(rate: float) -> None:
    for seed in range(20):
        sigma, turns = Dives(seed, rate).judge(np.zeros(5400))
        assert (sigma == SIGMA).all()
        assert turns.notices == []


@pytest.mark.parametrize("offset", [(60.0, 0.0, 0.0), (0.0, 80.0, 0.0), (0.0, 0.0, -400.0)])
def test_an_offset_is_seen_within_the_first_turns_and_sigma_is_what_they_do(
    offset: tuple[float, float, float],
) -> None:
    dives = Dives()
    error = dives.u @ np.array(offset)
    sigma, turns = dives.judge(error)
    late = dives.steady & (np.arange(5400) > 20 * LEG)
    assert (np.abs(error - error[late].mean())[late] < 3.0 * sigma[late]).all()
    assert np.median(sigma[late]) == pytest.approx(np.ptp(error[late]), rel=0.4)
    assert len(turns.notices) == 1
    size = float(turns.notices[0].split()[3])
    assert 0.3 * np.ptp(error) < size < 1.5 * np.ptp(error)


def test_a_doubt_ends_when_turns_change_nothing_any_more() -> None:
    dives = Dives()
    error = dives.u @ np.array([60.0, 0.0, 0.0])
    error[1000:] = 0.0
    sigma, turns = dives.judge(error)
    assert (sigma[700:1000] > 20.0).all()
    assert (sigma[-400:] == SIGMA).all()
    again, _ = dives.judge(dives.u @ np.array([60.0, 0.0, 0.0]), turns)
    assert (again[2000:] > 20.0).all()
    assert len(turns.notices) == 1, "told once"


def test_where_rock_changes_fast_only_more_than_that_is_seen() -> None:
    dives = Dives(rate=0.5)
    small, _ = dives.judge(dives.u @ np.array([30.0, 0.0, 0.0]))
    assert (small == SIGMA).all()
    large, _ = dives.judge(dives.u @ np.array([1500.0, 0.0, 0.0]))
    assert (large[2000:] > 300.0).all()


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize(("sigmas", "seen"), [(5.4, True), (5.2, False)])
def test_one_turn_alone_may_tell(sigmas: float, seen: bool, axis: int) -> None:
    """The sum of squares over their variance, less three, is the statistic: 28 is the limit of the first."""
    assert (sigmas**2 - 3.0 > ALARM) is seen
    turns, quiet = Turns(), SIGMA**2
    for k in range(1, 11):  # a straight course of ten minutes
        assert turns.check(k * 60_000_000, FIELD, 0.0, 0.0, FIELD, quiet, 0) == 0.0
    rock = (LEAST * 60.0) ** 2 * (1.0 + 4.0 / 9.0)
    F = FIELD + sigmas * (2.0 * quiet + rock) ** 0.5
    y, z = (F, 0.0) if axis == 1 else (0.0, F)
    more = turns.check(660_000_000, 0.0, y, z, F, quiet, 0)
    assert more == (pytest.approx((F - FIELD) ** 2) if seen else 0.0)


def test_the_rate_is_the_mean_square_of_what_straight_courses_do() -> None:
    """In the first four windows, whatever they are; later one counts as 64 times the usual at most."""
    for first, then, rate2 in (
        ([30.0, 0.0, 0.0, 0.0], [], (0.25 + 3.0 * LEAST**2) / 4.0),
        ([6.0] * 4, [6000.0], 0.01 + (64.0 - 1.0) * 0.01 / 5.0),
    ):
        for share, seen in ((1.03, True), (0.97, False)):
            turns, F, k = Turns(), FIELD, 1
            turns.check(60_000_000, F, 0.0, 0.0, F, 0.0, 0)
            for change in (*first, *then):
                k, F = k + 1, F + change
                turns.check(k * 60_000_000, F, 0.0, 0.0, F, 0.0, 0)
            F += share * (28.0 * rate2 * 3600.0 * (1.0 + 4.0 / (k - 1))) ** 0.5
            assert (turns.check((k + 1) * 60_000_000, 0.0, F, 0.0, F, 0.0, 0) > 0.0) is seen


def flagged() -> list[int]:
    return [int(Quality.MOVING), int(Quality.IMPLAUSIBLE), int(Quality.LATE_JOIN), int(Quality.SATURATED)]


@pytest.mark.parametrize("flag", flagged())
def test_what_is_flagged_says_nothing(flag: int) -> None:
    dives = Dives()
    wrong: BoolArray = np.arange(5400) % (2 * LEG) < LEG
    dives.quality[wrong] = flag
    sigma, turns = dives.judge(np.where(wrong, 500.0, 0.0))
    assert turns.notices == []
    assert (sigma == SIGMA).all()


def test_another_calibration_begins_anew() -> None:
    dives = Dives()
    error = dives.u @ np.array([60.0, 0.0, 0.0])
    _, turns = dives.judge(error)
    dives.time += 6.0 * 3600.0
    turns.explain(float(dives.rock[0] - dives.rock[-1] - error[-1]))
    sigma, _ = dives.judge(np.zeros(5400), turns)
    assert (sigma == SIGMA).all()


def test_a_pause_and_a_clock_that_goes_back_are_no_turn() -> None:
    for after in (1_000_000_000, -3_600_000_000):
        turns = Turns()
        for k in range(10):
            turns.check(3_600_000_000 + k * 60_000_000, FIELD, 0.0, 0.0, FIELD, 1.0, 0)
        later = 3_600_000_000 + 540_000_000 + after
        assert turns.check(later, 0.0, FIELD + 900.0, 0.0, FIELD + 900.0, 1.0, 0) == 0.0
        later += 61_000_000
        assert turns.check(later, FIELD, 0.0, 0.0, FIELD, 1.0, 0) > 0.0
