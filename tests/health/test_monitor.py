"""Test that the monitor detects and reports each fault once, and does not flag a healthy sensor."""

from collections.abc import Callable
from functools import partial
from math import nan

import numpy as np
import pytest

from magbridge.arrays import BoolArray, FloatArray, IntArray
from magbridge.calibration.model import Noise
from magbridge.health import HealthMonitor
from magbridge.health.checks import Messages
from magbridge.health.consistency import Sensitivity
from magbridge.health.scatter import Scatter
from magbridge.records import Quality

IMPLAUSIBLE, MOVING = int(Quality.IMPLAUSIBLE), int(Quality.MOVING)
SIGMA, FIELD, PERIOD_US = 1.9, 52_000.0, 4_000_000


class Flight:
    """Simulated vehicle in a main field of 52,000 nT and a crustal field, with 1 nT of noise."""

    def __init__(self, n: int = 1500, seed: int = 1, steps: float = 0.01) -> None:
        rng = np.random.default_rng(seed)
        time = 4.0 * np.arange(n)
        rock = 40.0 * np.sin(time / 900.0) + 15.0 * np.sin(time / 260.0)
        turn = np.cumsum(rng.normal(0.0, 0.05, (n, 3)), axis=0) + np.array([1.0, 0.5, 2.0])
        direction = turn / np.linalg.norm(turn, axis=1)[:, None]
        self.raw: FloatArray = (FIELD + rock)[:, None] * direction + rng.normal(0.0, 1.0, (n, 3))
        self.raw = np.rint(self.raw / steps) * steps
        self.quality = np.zeros(n, int)

    def judge(
        self, reference: float | FloatArray = FIELD, speed: float = 0.0
    ) -> tuple[IntArray, FloatArray, list[str]]:
        """Return the flags (n,), the sigma (n,) and the messages; a speed of 0 (m/s) is not known.

        `reference`: main field, nT, one or of each sample.
        """
        judge = HealthMonitor(Noise(1.0))
        references = np.broadcast_to(reference, len(self.raw)).tolist()
        flags: list[int] = []
        sigma: list[float] = []
        total = np.linalg.norm(self.raw, axis=1).tolist()
        for k, raw in enumerate(self.raw.tolist()):
            quality = int(self.quality[k])
            if speed:
                judge.set_position(k * PERIOD_US, 48.0 + speed * 4.0 * k / 111_200.0, -57.0)
            more = judge.check(
                k * PERIOD_US, tuple(raw), tuple(raw), (total[k], SIGMA), quality,
                (references[k], 145.0), nan, 0.0, Sensitivity,
            )  # fmt: skip
            flags.append(judge.flags)
            sigma.append((SIGMA**2 + more) ** 0.5)
        return np.array(flags), np.array(sigma), judge.messages


@pytest.mark.parametrize("first", [nan, FIELD], ids=["at last", "at first"])
def test_a_main_field_that_is_known_at_times_is_no_fault(first: float) -> None:
    """A vehicle has its first position late, or positions at the surface only."""
    flight = Flight(n=3000)
    known = np.where(np.arange(3000) // 250 % 2 == 0, FIELD, nan)
    known[:250] = first
    flags, sigma, reported = flight.judge(known)
    assert not flags.any()
    assert reported == []
    assert (sigma[200:] == SIGMA).all()


def along(raw: FloatArray, by: float) -> FloatArray:
    """Return the change of `raw` (n, 3) that increases the total field by a number of nT."""
    return np.asarray(by * raw / np.linalg.norm(raw, axis=1)[:, None])


@pytest.mark.parametrize("steps", [1e-3, 0.5, 6.7, 100.0])
@pytest.mark.parametrize("reference", [FIELD, nan])
def test_a_healthy_sensor_is_left_alone(steps: float, reference: float) -> None:
    """This includes a sensor with steps far above its noise, as an HMR2300 or an autopilot's compass."""
    flight = Flight(n=3000, steps=steps)
    if steps > 1.0:
        flight.raw[:, 2] = flight.raw[:, 2] + 0.0
    flags, sigma, reported = flight.judge(reference)
    assert np.mean(flags != 0) <= 0.001
    if steps < 1.0:
        assert not flags.any()
        assert reported == []
        assert (sigma[200:] == SIGMA).all()


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (lambda raw: raw / 1000.0, "sensor or calibration"),
        (lambda raw: raw * 1.02, "sensor or calibration"),
        (lambda raw: raw * [1.0, 1.0, 0.0] + [0.0, 0.0, 31_234.0], "axis z stuck at 31234 nT"),
        (lambda raw: raw + along(raw, 100.0), "which no telemetry explains"),
    ],
)
def test_a_fault_on_the_way_is_flagged_from_there_on(
    fault: Callable[[FloatArray], FloatArray], text: str
) -> None:
    flight = Flight()
    flight.raw[700:] = fault(flight.raw[700:])
    flags, sigma, reported = flight.judge()
    assert not flags[:700].any()
    assert (flags[710:] & IMPLAUSIBLE).all() or (sigma[710:][flags[710:] == 0] > 30.0).all()
    assert np.mean(flags[700:710] == 0) <= 0.9
    assert len([line for line in reported if text in line]) == 1


def test_spikes_are_flagged_one_by_one() -> None:
    flight = Flight()
    hit = np.random.default_rng(7).random(1500) < 0.03
    hit[:10] = False
    flight.raw[hit] += along(flight.raw[hit], 500.0)
    flags, sigma, reported = flight.judge()
    assert (flags[hit] == IMPLAUSIBLE).all()
    assert np.mean(flags[~hit] != 0) < 0.005
    assert np.median(sigma[~hit]) == SIGMA
    assert reported == []


def test_a_jump_that_comes_back_soon_is_forgotten_and_one_that_stays_is_not() -> None:
    flight = Flight()
    flight.raw[500:515] += along(flight.raw[500:515], 200.0)  # a ship passes: one minute
    flags, sigma, reported = flight.judge()
    assert (flags[500:515] == IMPLAUSIBLE).all()
    assert not flags[540:].any()
    assert (sigma[520:550] > 100.0).all()
    assert (sigma[580:] == SIGMA).all(), "four minutes after the second jump"
    assert len(reported) == 1
    flight.raw[515:1000] += along(flight.raw[515:1000], 200.0)
    flags, sigma, _ = flight.judge()
    assert (flags[500:1000] == IMPLAUSIBLE).all()
    assert (sigma[1000:1400] > 100.0).all()  # a right value may still be wrong
    flight = Flight(n=2500)
    flight.raw[500:1000] += along(flight.raw[500:1000], 200.0)
    flags, sigma, _ = flight.judge()
    assert (flags[500:1000] == IMPLAUSIBLE).all()
    assert (sigma[1000:1400] > 100.0).all()
    assert not flags[2000:].any()
    assert (sigma[2000:] == SIGMA).all(), "after an hour at the latest"


@pytest.mark.parametrize("speed", [0.35, 15.0])
@pytest.mark.parametrize("reference", [FIELD, nan])
@pytest.mark.parametrize(
    ("disturbance", "seconds", "turn"),
    [
        (2000.0, 8, 0.0), (2000.0, 120, 0.0),
        ((2000.0, 0.0, 0.0), 8, 2.0), ((600.0, 0.0, 0.0), 8, 5.0), ((2000.0, 0.0, 0.0), 16, 2.0),
    ],
    ids=["total", "total, long", "turning", "turning fast", "turning, longer"],
)  # fmt: skip
def test_a_disturbance_that_ends_is_forgotten(
    disturbance: float | tuple[float, float, float],
    seconds: int,
    turn: float,
    reference: float,
    speed: float,
) -> None:
    """A vehicle with 10 samples a second turns by `turn` deg/s; the disturbance begins and ends at once."""
    rng, judge, begin = np.random.default_rng(1), HealthMonitor(Noise(0.5)), 600
    end = begin + 10 * seconds
    time = 0.1 * np.arange(end + 4000)
    yaw = np.radians(30.0 + turn * time)
    unit = np.stack([0.4 * np.cos(yaw), -0.4 * np.sin(yaw), np.full(len(time), 0.84**0.5)], axis=1)
    raw = (FIELD + 40.0 * np.sin(speed * time / 300.0))[:, None] * unit
    truth = np.linalg.norm(raw, axis=1)
    raw[begin:end] += along(raw[begin:end], disturbance) if isinstance(disturbance, float) else disturbance
    raw += rng.normal(0.0, 0.5, raw.shape)
    total = np.linalg.norm(raw, axis=1)
    flags, sigma = [], []
    for k, one in enumerate(raw.tolist()):
        judge.set_position(k * 100_000, 48.0 + speed * time[k] / 111_200.0, -57.0)
        variance = judge.check(
            k * 100_000, one, one, (float(total[k]), SIGMA), 0, (reference, 145.0), nan, 0.0, Sensitivity
        )
        flags.append(judge.flags)
        sigma.append((SIGMA**2 + variance) ** 0.5)
    z = np.abs(total - truth) / sigma
    assert all(flags[begin:end])
    if seconds < 10 or np.isnan(reference):  # else the check of the level flags for an hour
        assert not any(flags[end + 10 :])
    assert max(sigma[end + 2500 :]) < 2.0 * SIGMA, "four minutes after the second jump"
    assert z[np.array(flags) == 0].max() < 3.0


def test_a_mass_that_moves_is_not_a_jump_if_the_field_stays_and_one_if_it_does_not() -> None:
    flight = Flight()
    flight.quality[695:705] = MOVING
    flight.raw[695:700] += along(flight.raw[695:700], 300.0)  # while it moves, nothing is known
    flags, _, reported = flight.judge()
    assert not flags.any()
    flight.raw[700:] += along(flight.raw[700:], 150.0)
    flags, _, reported = flight.judge()
    assert (flags[705:] == IMPLAUSIBLE).all()
    assert "as telemetry changes: calibration or telemetry wrong" in reported[0]


def test_a_wrong_mass_is_seen_if_it_moves_with_the_very_second_sample() -> None:
    flight = Flight()
    flight.quality[1:5] = MOVING
    flight.raw[5:] += along(flight.raw[5:], -460.0)
    flags, sigma, reported = flight.judge()
    assert ((flags[5:] == IMPLAUSIBLE) | (sigma[5:] > 400.0)).all()
    assert any("as telemetry changes" in line for line in reported)


def test_a_spike_that_a_mass_s_move_makes_acceptable_is_not_a_new_level() -> None:
    """After 40 s of motion the crustal field may differ by 80 nT; equal samples show that it does not."""
    flight = Flight()
    flight.quality[690:700] = MOVING
    flight.raw[700] += along(flight.raw[700:701], 60.0)[0]
    flags, _, reported = flight.judge()
    assert not flags[:690].any()
    assert (flags[701:] == IMPLAUSIBLE).sum() <= 3
    assert reported == []


def test_clipping_is_remembered() -> None:
    """The first time it takes some samples to see; from then on it is seen at once."""
    flight = Flight()
    limit = float(np.quantile(flight.raw[:, 2], 0.8))
    clipped = flight.raw[:, 2] > limit
    flight.raw[:, 2] = np.minimum(flight.raw[:, 2], limit)
    flags, _, reported = flight.judge()
    missed = clipped & (flags == 0)
    assert missed.sum() <= 10
    assert missed[np.flatnonzero(clipped)[30] :].sum() == 0
    assert any("axis z stuck" in line for line in reported)


def test_a_value_that_readings_exceed_is_not_a_limit() -> None:
    """The axis sticks at its largest reading so far; later readings of this value are right."""
    flight = Flight()
    z = flight.raw[:, 2]
    z[400:460] = np.abs(z[:400]).max()
    z[600] = 1.01 * z[400]
    z[500:1500:200] = z[400]
    stuck = coarse_flags(flight.raw)[1]
    assert stuck[420:460].all()
    assert stuck[500], "until a reading exceeds it, the value may be a limit"
    assert not stuck[600:].any()


COARSE_NT = 20.0 / 3.0
"""Step of an HMR2300, nT."""


def coarse_flags(raw: FloatArray, rate: int = 20) -> tuple[IntArray, BoolArray]:
    """Return the flags (n,) of a coarse sensor's readings, and where an axis is stuck (n,)."""
    judge = HealthMonitor(Noise(2.0))
    total = np.linalg.norm(raw, axis=1).tolist()
    flags, stuck = [], []
    for k, (x, y, z) in enumerate(raw.tolist()):
        one, time_us = (x, y, z), k * 1_000_000 // rate
        judge.check(time_us, one, one, (total[k], 2.0), 0, (total[0], 145.0), nan, 0.0, Sensitivity)
        flags.append(judge.flags)
        stuck.append(any(axis.is_faulty for axis in judge._axes._axes))
    return np.array(flags), np.array(stuck)


@pytest.mark.parametrize("rate", [1, 20])
@pytest.mark.parametrize("noise", [[0.5], [1.0], [2.0], [3.0], [4.0], [4.0, 4.0, 0.5]], ids=str)
def test_a_coarse_sensor_at_rest_is_not_stuck(noise: list[float], rate: int) -> None:
    """One channel of several hundred readings may have one value, and another change by one step."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        raw = rng.normal(0.0, noise, (60 * rate, 3)) + np.array([18_000.0, -7000.0, 46_000.0])
        raw += rng.uniform(0.0, COARSE_NT, 3)
        assert not coarse_flags(np.rint(raw / COARSE_NT) * COARSE_NT, rate)[0].any()


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_a_stuck_axis_of_a_coarse_sensor_is_found_as_soon_as_the_vehicle_moves(noise: float) -> None:
    time = np.arange(2000) / 20.0
    yaw, pitch = 0.6 * np.sin(time / 4.0), 0.02 * np.sin(time / 1.7)
    yaw[:600] = pitch[:600] = 0.0
    north, down = 18_000.0, 46_000.0
    raw = np.stack(
        [north * np.cos(yaw) - down * pitch, -north * np.sin(yaw), down + north * np.cos(yaw) * pitch], 1
    )
    raw += np.random.default_rng(3).normal(0.0, noise, raw.shape)
    raw = np.rint(raw / COARSE_NT) * COARSE_NT
    assert not coarse_flags(raw)[1].any()
    raw[300:, 2] = raw[300, 2]
    stuck = coarse_flags(raw)[1]
    assert not stuck[:600].any()
    assert stuck[600 + 15 * 20 :].all()


def test_more_noise_than_the_calibration_s_widens_sigma_within_a_hundred_samples() -> None:
    flight = Flight(n=3000)
    before = np.linalg.norm(flight.raw, axis=1)
    flight.raw[700:] += np.random.default_rng(2).normal(0.0, 20.0, (2300, 3))
    flags, sigma, reported = flight.judge()
    error = np.abs(np.linalg.norm(flight.raw, axis=1) - before)
    wrong = (flags == 0) & (error > 3.0 * sigma)
    assert np.median(sigma[1000:]) == pytest.approx(20.0 * (4 / 3) ** 0.5, rel=0.2)
    assert np.mean(wrong[800:]) < 0.004
    assert np.mean(wrong[700:800]) < 0.08
    assert [line for line in reported if "noise" in line]
    assert len(reported) == len(set(reported))


@pytest.mark.parametrize("period", [13.0, 25.0, 37.0, 60.0, 150.0])
@pytest.mark.parametrize("size", [12.0, 40.0])
def test_interference_widens_sigma_or_is_flagged_at_low_speed(period: float, size: float) -> None:
    """At 0.35 m/s a crustal field of 500 m takes 24 min; second differences of samples do not show it."""
    flight = Flight(n=3000)
    before = np.linalg.norm(flight.raw, axis=1)
    hum = size * np.sin(2.0 * np.pi * 4.0 * np.arange(2500) / period)
    flight.raw[500:] += along(flight.raw[500:], 1.0) * hum[:, None]
    flags, sigma, reported = flight.judge(speed=0.35)
    wrong = (flags == 0) & (np.abs(np.linalg.norm(flight.raw, axis=1) - before) > 3.0 * sigma)
    assert np.mean(wrong[500:]) < 0.02
    assert np.mean(wrong[700:]) < 0.004
    assert reported


@pytest.mark.parametrize("speed", [0.35, 2.0, 20.0])
def test_a_crustal_field_of_half_a_kilometre_is_not_noise_at_any_speed(speed: float) -> None:
    flight = Flight(n=3000)
    way = speed * 4.0 * np.arange(3000)
    flight.raw += along(flight.raw, 1.0) * (145.0 * 2.0**0.5 * np.sin(2.0 * np.pi * way / 500.0))[:, None]
    _, sigma, reported = flight.judge(speed=speed)
    assert (sigma == SIGMA).all() or speed > 10.0
    assert [line for line in reported if "noise" in line] == [] or speed > 10.0  # 80 m from sample to sample


@pytest.mark.parametrize("times", [5.0, 20.0])
def test_noise_from_the_start_on_widens_sigma_within_ten_samples(times: float) -> None:
    wrong = []
    for seed in range(8):
        flight = Flight(n=2000, seed=seed)
        before = np.linalg.norm(flight.raw, axis=1)
        flight.raw += np.random.default_rng(seed).normal(0.0, times, flight.raw.shape)
        flags, sigma, _ = flight.judge()
        wrong.append((flags == 0) & (np.abs(np.linalg.norm(flight.raw, axis=1) - before) > 3.0 * sigma))
    assert np.mean(wrong) < 0.006
    assert np.mean(np.array(wrong)[:, 10:]) < 0.004
    _, quiet, reported = Flight(n=2000).judge()
    assert (quiet[50:] == SIGMA).all()
    assert reported == []


@pytest.mark.parametrize("sigmas", [3.2, -3.2, 4.2])
def test_a_field_that_is_far_off_from_the_first_on_has_that_as_its_sigma(sigmas: float) -> None:
    """A gain error of 1 % is 500 nT; it is not flagged, since a crustal field may be as large."""
    flight = Flight()
    off = 145.0 * sigmas
    flags, sigma, reported = flight.judge(reference=FIELD - off)
    error = np.abs(np.linalg.norm(flight.raw, axis=1) - FIELD + off)
    far = error > 3.0 * np.hypot(145.0, SIGMA)
    assert far.mean() > 0.5
    assert sigma[far] == pytest.approx(np.hypot(error[far], SIGMA))
    assert not flags.any()
    assert [line for line in reported if "sigma is widened" in line] == reported[:1]


def test_a_slowly_changing_crustal_field_is_not_a_fault() -> None:
    flight = Flight(n=3000)
    rise = np.interp(np.arange(3000), [200, 2000], [200.0, 600.0])
    flight.raw += rise[:, None] * flight.raw / np.linalg.norm(flight.raw, axis=1)[:, None]
    flags, sigma, _ = flight.judge()
    assert not flags.any()
    far = np.linalg.norm(flight.raw, axis=1) - FIELD > 3.0 * np.hypot(145.0, SIGMA)
    assert (sigma[~far & (np.arange(3000) < 1500)] == SIGMA).all()
    assert (sigma[far] > 400.0).all(), "the reference excludes that a sigma of 2 nT is right"
    for off, span in ((350.0, True), (100.0, False)):  # 3.4 sigmas or more at first, then 2.4 or 0.7
        flags, sigma, _ = flight.judge(reference=FIELD + 600.0 + off)
        assert (sigma[:100] > 400.0).all()
        assert (sigma[-100:] > 250.0).all() if span else (sigma[-100:] == SIGMA).all()


def test_without_a_position_only_what_is_nowhere_on_earth_is_wrong() -> None:
    flight = Flight(n=50)
    assert not flight.judge(reference=nan)[0].any()
    flight.raw *= 0.2
    flags, _, reported = flight.judge(reference=nan)
    assert (flags == IMPLAUSIBLE).all()
    assert "expected 17000 to 72000" in reported[0]


def test_a_sigma_as_large_as_the_earth_s_field_tells_nothing() -> None:
    """Telemetry in a wrong unit takes the calibration's polynomials to any size, and the sigma with them."""
    flight, judge, rng = Flight(n=400), HealthMonitor(Noise(1.0)), np.random.default_rng(1)
    for k, raw in enumerate((4e3 * flight.raw).tolist()):
        total = float(np.linalg.norm(raw))
        effects = 1e10 * rng.normal(size=9)
        variance = judge.check(
            k * PERIOD_US, tuple(flight.raw[k].tolist()), tuple(raw), (total, 80.0 * total), 0,
            (FIELD, 145.0), nan, 0.0, partial(Sensitivity, (), effects),
        )  # fmt: skip
        assert variance >= 0.0


def test_memory_and_state_do_not_grow() -> None:
    judge = HealthMonitor(Noise(1.0))
    rng = np.random.default_rng(3)
    for k in range(3000):
        raw = tuple(rng.normal(0.0, 4e4, 3).tolist())
        total = float(np.linalg.norm(raw)), SIGMA
        judge.check(k * PERIOD_US, raw, raw, total, 0, (FIELD, 145.0), nan, 0.0, Sensitivity)
    assert len(judge.messages) <= 5


def test_one_jump_of_the_position_is_no_speed_and_two_in_a_row_are() -> None:
    scatter = Scatter(Noise(1.0), Messages())

    def speed_after(minute: int, metres: float) -> float:
        scatter.set_position(minute * 60_000_000, 48.0 + metres / 111_200.0, -57.0)
        return scatter.speed

    speeds = [speed_after(minute, 60.0 * minute) for minute in range(60)]
    assert speeds[-1] == pytest.approx(1.0, rel=0.01)
    jumped = [speed_after(minute, 60.0 * minute + 5_400.0) for minute in range(60, 90)]  # as at a fix
    assert jumped == pytest.approx([1.0] * 30, rel=0.01)
    assert [speed_after(minute, 600.0 * minute) for minute in range(90, 93)][-1] == pytest.approx(
        10.0, rel=0.01
    )
