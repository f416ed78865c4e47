"""The equations of the checks, each beside the number that its docstring gives."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.health import Plausibility
from magbridge.health.jump import GATE, SLOPE_US
from magbridge.health.level import FAR, LEVEL, NEAR
from magbridge.health.notices import Notices
from magbridge.health.scatter import QUIETEST, Scatter
from magbridge.records import Quality

FIELD, IMPLAUSIBLE, MOVING = 50_000.0, int(Quality.IMPLAUSIBLE), int(Quality.MOVING)
HOUR = 3600.0


class Fed:
    """Feeds a judge with fields, nT about 50,000, every so many seconds; its channels never repeat."""

    def __init__(self, noise: float = 1.0, sigma: float = 0.5, every: float = 4.0) -> None:
        self.judge = Plausibility(noise)
        self.noise, self.sigma, self.every = noise, sigma, every
        self.time = 0.0
        self.count = 0

    def quiet(self, seconds: float, base: float = 0.0) -> None:
        """Feed a level with so little noise that it is not what decides, and rock as smooth as any."""
        for _ in range(round(seconds / self.every)):
            self(base + 0.01 * self.noise * (-1) ** self.count)

    def __call__(self, off: float, quality: int = 0, after: float | None = None) -> float:
        """Feed one; return the variance that is added."""
        self.time += self.every if after is None else after
        self.count += 1
        F = FIELD + off
        raw = (F + self.count, F - self.count, 1e-3 * self.count)
        return self.judge.check(round(self.time * 1e6), raw, F, self.sigma, quality, FIELD, 1e6)

    @property
    def flagged(self) -> bool:
        return bool(self.judge.flags & IMPLAUSIBLE)


def gate(noise: float, sigma2: float = 0.0, slope: float = 0.05, seconds: float = 4.0) -> float:
    """Return the innovation, nT, that is just acceptable: 7 sigmas of a level's, a slope's and a sensor's."""
    floor = 1.5 * max(noise, QUIETEST) ** 2
    return float((GATE**2 * (floor + sigma2) + (5.0 * slope * seconds) ** 2) ** 0.5)


@pytest.mark.parametrize("noise", [1.0, 3.0, 0.01])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_gate_of_a_jump_is_seven_sigmas(noise: float, sign: float) -> None:
    for share, seen in ((0.97, False), (1.03, True)):
        fed = Fed(noise)
        fed.quiet(12.0 * HOUR)  # until the slope is the least
        fed(sign * share * gate(noise))
        assert fed.flagged is seen


@pytest.mark.parametrize("sigma", [0.5, 10.0])
def test_after_a_motion_both_sigmas_count_and_the_time_that_it_took(sigma: float) -> None:
    for share, seen in ((0.97, False), (1.03, True)):
        fed = Fed(sigma=sigma)
        fed.quiet(12.0 * HOUR)
        for _ in range(20):
            fed(0.0, MOVING)
        just = gate(1.0, 2.0 * sigma**2, seconds=84.0)
        fed(share * just)
        assert fed.flagged is seen
        if seen:
            for _ in range(3):  # that agree are another level
                fed(3.0 * just)
            assert f"jumps by {3.0 * just:+.0f} nT as a mass moves" in fed.judge.notices[0]


@pytest.mark.parametrize("slope", [0.3, 2.0])
def test_the_slope_is_that_of_the_level(slope: float) -> None:
    """After a pause of two minutes the gate is what the slope makes of it."""
    for share, seen in ((0.7, False), (1.4, True)):
        fed = Fed()
        sawtooth = np.abs(np.arange(20_000) % 200 - 100) * 4.0 * slope
        for off in sawtooth:
            fed(float(off))
        last = float(sawtooth[-1])
        fed(last + share * gate(1.0, slope=slope, seconds=120.0), after=120.0)
        assert fed.flagged is seen


def test_what_is_told_of_a_jump_is_its_size_and_sigma_is_that_until_it_is_over() -> None:
    fed = Fed()
    fed.quiet(HOUR)
    for off, squares in ((100.0, 1), (104.0, 1), (106.0, 2)):  # the third is a level: that jump is remembered
        assert fed(off) == pytest.approx(squares * off**2, rel=0.05)
        assert fed.flagged
    assert fed.judge.notices == ["field jumps by +104 nT, which no telemetry explains"]
    more = [fed(104.0) for _ in range(50)]
    assert min(more) == pytest.approx(104.0**2, rel=0.02)
    assert more[20:] == pytest.approx([min(more)] * 30, rel=0.02)
    assert fed.flagged
    fed.quiet(60.0)
    assert not fed.flagged
    assert (
        fed.judge.check(round(fed.time * 1e6) + 4_000_000, (1.0, 2.0, 3.0), FIELD, 0.5, 0, FIELD, 1e6) > 1e4
    )


def test_after_a_spike_the_next_sample_is_less_sure_and_within_a_burst_even_less() -> None:
    fed = Fed()
    fed.quiet(12.0 * HOUR)
    most = 16.0 * gate(1.0) ** 2
    for pause, share in ((40, 0.3), (3, 0.3), (40, 0.8)):
        fed(500.0)
        assert fed.flagged
        more = [fed(0.0) for _ in range(pause)]
        assert more[:2] == pytest.approx([share * most, share**2 * most], rel=0.02)
        assert (more[-1] == 0.0) is (pause == 40)


def test_a_level_that_is_wrong_at_first_is_none_to_jump_from() -> None:
    judge = Plausibility(1.0)
    for k in range(4):
        judged(900.0, judge=judge, at=k)
    for k in range(4, 30):
        judged(0.0, judge=judge, at=k)
    assert not [text for text in judge.notices if "jumps" in text]


@pytest.mark.parametrize("level", [0.0, 145.0])
def test_a_level_that_all_samples_share_is_no_noise(level: float) -> None:
    """A vehicle that calibrated itself knows its level to 145 nT, and the rest to one."""
    judge, rng = Plausibility(1.0, level=level), np.random.default_rng(5)
    more = []
    for k in range(100):
        x, y, z = (20_000.0 + rng.normal(0.0, 1.0, 3)).tolist()
        more.append(judge.check(k * 4_000_000, (x, y, z), FIELD + rng.normal(), 145.01, 0, FIELD, 145.0))
        assert not judge.flags
    assert any("noise" in text for text in judge.notices) is (level == 0.0)
    assert (max(more) == 0.0) is (level > 0.0)


def test_repeats_are_counted_from_the_last_change() -> None:
    judge = Plausibility(1.0)
    for k in range(400):  # three of a kind, for ever
        x = 20_000.0 + 7.0 * (k // 3)
        judge.check(k * 4_000_000, (x, 30_000.0 + k, 35_000.0 - k), FIELD, 0.5, 0, FIELD, 1e6)
        assert judge.flags == 0


def remembered(fed: Fed) -> float:
    """Return for how long, s, a level that is as before has a wider sigma."""
    began = fed.time
    while fed(0.01 * (-1) ** fed.count) > 0.0:
        assert fed.time - began < 30.0 * HOUR
    return fed.time - began


def test_a_fault_that_comes_again_is_remembered_four_times_longer() -> None:
    """A minute, four, sixteen, and an hour at most."""
    fed = Fed()
    fed.quiet(HOUR)
    for minutes in (4.0, 60.0, 60.0):  # to and fro are two jumps
        for _ in range(5):
            fed(100.0)
        assert remembered(fed) == pytest.approx(60.0 * minutes, abs=30.0)


def test_a_fault_of_a_mass_is_remembered_for_hours() -> None:
    fed = Fed()
    fed.quiet(HOUR)
    for hours in (4.0, 24.0):
        for off in (100.0, 0.0):
            fed(0.0, MOVING)
            for _ in range(5):
                fed(off)
        assert remembered(fed) == pytest.approx(hours * HOUR, abs=60.0)


def test_what_stood_for_long_is_remembered_as_long() -> None:
    fed = Fed()
    fed.quiet(HOUR)
    for _ in range(300):  # 20 minutes
        fed(100.0)
    assert remembered(fed) == pytest.approx(1200.0, abs=60.0)


@pytest.mark.parametrize(("times", "widened"), [(1.0, False), (3.0, True)])
def test_noise_is_added_from_two_and_a_half_times_the_calibration_s_on(times: float, widened: bool) -> None:
    rng = np.random.default_rng(1)
    fed = Fed()
    more = [fed(off) for off in rng.normal(0.0, times, 4000)]
    assert np.mean(np.array(more[1000:]) > 0.0) == pytest.approx(float(widened), abs=0.02)
    if widened:
        assert np.median(more[1000:]) == pytest.approx(4.0 / 3.0 * times**2, rel=0.15)
        assert fed.judge.notices == [], "reported from five times on"
        after = [fed(off) for off in rng.normal(0.0, 1.0, 2000)]
        assert not any(after[1000:])


def test_noise_five_times_the_calibration_s_is_told() -> None:
    fed = Fed()
    for off in np.random.default_rng(1).normal(0.0, 8.0, 1000):
        fed(off)
    assert [text for text in fed.judge.notices if text.endswith("sigma is widened")]


def judged(
    off: float, sigma: float = 10.0, judge: Plausibility | None = None, at: int = 0
) -> tuple[int, float]:
    judge = judge or Plausibility(1.0)
    more = judge.check(at * 4_000_000, (1.0 + at, 2.0 - at, 3.0 * at), FIELD + off, sigma, 0, FIELD, 145.0)
    return judge.flags, more


def test_the_level_s_limits_are_of_both_sigmas() -> None:
    both = float(np.hypot(145.0, 10.0))
    for sign in (1.0, -1.0):
        assert judged(sign * 0.999 * LEVEL * both)[0] == 0
        assert judged(sign * 1.001 * LEVEL * both)[0] == IMPLAUSIBLE
        assert judged(sign * 0.999 * FAR * both)[1] == 0.0
        assert judged(sign * 1.001 * FAR * both)[1] == pytest.approx((1.001 * FAR * both) ** 2)
    for start, seen in ((0.999, False), (1.001, True)):
        judge = Plausibility(1.0)
        judged(start * NEAR * both, judge=judge)
        assert (judged(1.001 * FAR * both, judge=judge, at=10)[1] >= (FAR * both) ** 2) is seen


def test_a_wrong_level_is_remembered_for_an_hour_if_it_lasted_eight_seconds() -> None:
    for samples, remembered_for in ((2, 0), (5, 900)):
        judge = Plausibility(1.0)
        for k in range(20):
            judged(0.0, judge=judge, at=k)
        for k in range(20, 20 + samples):
            assert judged(900.0, judge=judge, at=k)[0] == IMPLAUSIBLE
        flags = [judged(0.0, judge=judge, at=k)[0] for k in range(20 + samples, 2000)]
        reported = any(text.startswith("field of 50900 nT, expected 50000") for text in judge.notices)
        assert reported is (samples == 5)
        assert sum(flag != 0 for flag in flags[3:]) == pytest.approx(remembered_for, abs=4)


def test_a_burst_of_garbage_is_no_wrong_level() -> None:
    """Seven seconds at 1 Hz are forgotten, ten are not."""
    for seconds, kept in ((7, False), (10, True)):
        judge = Plausibility(1.0)
        flags = []
        for k in range(400):
            F = FIELD + (900.0 if 100 <= k < 100 + seconds else 0.0)
            judge.check(k * 1_000_000, (1.0 + k, 2.0 - k, 3.0 * k), F, 10.0, 0, FIELD, 145.0)
            flags.append(judge.flags)
        assert any(flags[200:]) is kept


def run_until_stuck(repeats: float, axis: int = 0) -> int:
    """Return after how many samples a channel that repeats itself so often is taken for stuck, if it is."""
    rng, judge = np.random.default_rng(1), Plausibility(1.0)
    x = 20_000.0

    def feed(k: int, value: float) -> int:
        raw = [30_000.0 + k, 35_000.0 - k]
        raw.insert(axis, value)
        judge.check(k * 4_000_000, (raw[0], raw[1], raw[2]), FIELD, 0.5, 0, FIELD, 1e6)
        return judge.flags

    for k in range(4000):
        x += 7.0 * (rng.random() >= repeats)
        flags = feed(k, x)
        assert not flags or k < 500, "until the share is known"
    x += 7.0
    return next(n for n in range(400) if feed(4000 + n, x))


def test_an_axis_is_stuck_when_so_many_repeats_are_one_chance_in_a_thousand_million() -> None:
    for axis in range(3):
        assert 4 <= run_until_stuck(0.0, axis) <= 6
    for p, axis in ((0.3, 0), (0.6, 0), (0.5, 1), (0.4, 2)):
        assert run_until_stuck(p, axis) == pytest.approx(np.log(1e-9) / np.log(p), rel=0.35)


def test_a_value_once_stuck_at_is_known_again_at_once_also_with_the_other_sign() -> None:
    judge = Plausibility(1.0)
    flags = []
    for k in range(40):
        x = 55_000.0 if 10 <= k < 25 else -55_000.0 if k == 30 else 20_000.0 + k
        judge.check(k * 4_000_000, (x, 30_000.0 + k, 35_000.0 - k), FIELD, 0.5, 0, FIELD, 1e6)
        flags.append(judge.flags)
        assert judge.fault is (judge.flags != 0)
    assert [k for k in range(40) if flags[k]] == [*range(21, 25), 30]
    judge = Plausibility(1.0)
    for _ in range(20):  # all three repeat: a driver that gives the last reading again
        judge.check(4_000_000, (1.0, 2.0, 3.0), FIELD, 0.5, 0, FIELD, 1e6)
        assert judge.flags == 0


def test_what_another_calibration_moves_is_no_jump() -> None:
    for by, seen in ((200.0, False), (0.0, True)):
        fed = Fed()
        fed.quiet(2.0 * HOUR)
        fed.judge.explain(by, jumps=False)
        fed(200.0)
        assert fed.flagged is seen
    fed = Fed()
    fed.quiet(HOUR)
    for _ in range(10):
        fed(100.0)
    assert fed.flagged
    fed.judge.explain(0.0, jumps=True)
    fed(100.0)
    assert not fed.flagged


def test_the_slope_is_measured_over_twenty_seconds() -> None:
    assert SLOPE_US == 20_000_000
    fast, slow = Fed(every=1.0), Fed(every=4.0)
    for fed in (fast, slow):
        for off in np.abs(np.arange(0.0, 20_000.0, fed.every) % 400.0 - 200.0):  # 1 nT/s
            fed(float(off))
        fed(float(off) + 0.8 * gate(1.0, slope=1.0, seconds=120.0), after=120.0)
        assert not fed.flagged


def scattered(speed: float, size: float, period: float, places: int = 2, every: float = 0.1) -> float:
    """Return what a hum adds to sigma, nT, of samples so many s apart with 1 nT of noise."""
    scatter, noise = Scatter(1.0, Notices()), np.random.default_rng(1).normal(0.0, 1.0, 3000)
    scatter.begin(9.0 * scatter.floor)
    for k in range(places):
        scatter.place((1 + k) * 60_000_000, 48.0 + k * speed * 60.0 / 111_200.0, -57.0)
    for k in range(3000):
        hum = size * np.sin(2.0 * np.pi * every * k / period)
        scatter.follow(200_000_000 + round(1e6 * every * k), FIELD + float(hum + noise[k]))
    return scatter.excess() ** 0.5


def test_how_long_a_lag_may_be_is_the_speed_s_to_say() -> None:
    """12 m at 20 m/s are 0.6 s, of which 0.4 is the longest lag in steps of 0.1 s."""
    assert 6.0 < scattered(20.0, 10.0, 2.0) < 14.0
    assert scattered(20.0, 0.0, 2.0) == 0.0
    assert scattered(200.0, 10.0, 2.0) == 0.0
    assert scattered(20.0, 10.0, 2.0, places=1) == 0.0, "nobody knows the speed"
    assert 8.0 < scattered(0.3, 10.0, 60.0) < 20.0, "at 10 Hz, lags of 24 s"
    assert scattered(0.3, 10.0, 600.0) == 0.0
