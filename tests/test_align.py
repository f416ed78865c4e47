"""Test the alignment: interpolation, ages, and a flag for each reason that makes a sample uncertain."""

from math import inf, nan

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from magbridge.align import Aligner, Input, Sample
from magbridge.calibration.fitting.observe import at_one_time
from magbridge.config import Align
from magbridge.one_time import OneTime, interpolate_to_rows
from magbridge.records import Quality, Reading

SECOND = 1_000_000
START = 1_700_000_000 * SECOND
BATTERY = Input("battpos", -1.0, 1.0, max_age=10.0)


def reading(value: float = 100.0, **more: object) -> Reading:
    return Reading((value, value, value), **more)  # type: ignore[arg-type]


def flags(sample: Sample) -> set[str]:
    return set(Quality(sample.quality).names().split())


DELAY = st.tuples(*[st.floats(0, 2)] * 3)


@given(DELAY, DELAY, st.floats(-1e3, 1e3), st.floats(-50, 50), st.floats(0.0, 3.0))
def test_any_order_of_channels_and_any_filter_delay(
    first: tuple[float, float, float], delays: tuple[float, float, float], level: float, slope: float,
    filter_delay: float,
) -> None:  # fmt: skip
    """The delays may differ from reading to reading, as of a converter that loses its beat."""
    aligner = Aligner((), Align(filter_delay=filter_delay))
    for t, late in ((0.0, first), (4.0, delays)):
        x, y, z = (level + slope * (t + delay) for delay in late)
        sample = aligner.reading(Reading((x, y, z), channel_delay=late), START + round(t * SECOND))
    assert sample.time_us % 4 == 0  # the two low bits belong to the log
    expected = level + slope * (4.0 + min(delays))
    np.testing.assert_allclose(sample.field, expected, atol=1e-6)
    assert abs(sample.time_us - (START + (4.0 + min(delays) - filter_delay) * SECOND)) <= 5


def test_telemetry_is_looked_up_at_the_sample_s_time() -> None:
    aligner = Aligner((BATTERY,), Align(filter_delay=2.0, moving_rate=10.0))
    for k in range(8):
        aligner.telemetry("battpos", START + k * SECOND, 0.1 * k)
    sample = aligner.reading(reading(), START + 7_250_000)
    assert sample.values[0] == pytest.approx(0.525)  # at 5.25 s, between two values
    assert sample.age == 0.0
    late = aligner.reading(reading(), START + 12 * SECOND)
    assert late.values[0] == pytest.approx(0.7)  # held
    assert late.age == pytest.approx(3.0)


def test_stale_telemetry_is_flagged_and_its_sigma_grows() -> None:
    aligner = Aligner((BATTERY,), Align(stale_growth=2.0))
    aligner.telemetry("battpos", START, 0.3)
    sigmas = []
    for k in range(1, 30):
        sample = aligner.reading(reading(), START + k * SECOND)
        assert ("stale_telemetry" in flags(sample)) == (k > 10)
        assert sample.values == (0.3,)
        sigmas.append(sample.sigma)
    assert sigmas[5] == 0.0
    assert sigmas[-1] == pytest.approx(2.0 * 29)


def test_telemetry_never_seen_spans_the_whole_range() -> None:
    ballast = Input("ballast", -1.0, 3.0, max_age=10.0)
    sample = Aligner((ballast,), Align()).reading(reading(), START)
    assert flags(sample) == {"stale_telemetry"}
    assert sample.values == (1.0,)  # the middle of the range
    assert sample.spans == ((0, -1.0, 3.0),)
    assert sample.age == inf


def test_before_the_first_telemetry_its_age_is_the_time_until_then() -> None:
    aligner = Aligner((BATTERY,), Align(filter_delay=5.0))
    aligner.telemetry("battpos", START, 0.3)
    sample = aligner.reading(reading(), START + 2 * SECOND)
    assert sample.values == (0.3,)
    assert sample.age == pytest.approx(3.0)
    assert flags(sample) == {"late_join"}
    assert flags(aligner.reading(reading(), START + 6 * SECOND)) == set()


def test_nan_telemetry_keeps_the_last_value_but_flags() -> None:
    aligner = Aligner((BATTERY,), Align())
    aligner.telemetry("battpos", START, 0.3)
    aligner.telemetry("battpos", START + SECOND, nan)
    sample = aligner.reading(reading(), START + SECOND)
    assert sample.values == (0.3,)
    assert "stale_telemetry" in flags(sample)
    aligner.telemetry("battpos", START + 2 * SECOND, 0.3)
    assert flags(aligner.reading(reading(), START + 2 * SECOND)) == set()


def test_a_moving_mass_is_flagged_until_it_rests() -> None:
    aligner = Aligner((BATTERY,), Align(settle_time=3.0))
    seen, before = [], 0.0
    for k in range(20):
        position = min(max(k - 5, 0), 5) * 0.1  # moves from 5 s to 10 s
        aligner.telemetry("battpos", START + k * SECOND, position)
        sample = aligner.reading(reading(), START + k * SECOND)
        seen.append("moving" in flags(sample))
        assert sample.spans == (((0, before, position),) if seen[-1] else ())
        before = position
    assert seen == [False] * 6 + [True] * 5 + [True] * 3 + [False] * 6


@pytest.mark.parametrize(("change", "moving"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("seconds", [0.2, 1.0])
@pytest.mark.parametrize("rests", [0.0, 1.1])
def test_a_change_within_a_second_is_motion_above_the_moving_rate(
    change: float, seconds: float, rests: float, *, moving: bool
) -> None:
    """Changes sooner than a second count as changes within a second, so that noise is no motion.

    A rest before the change does not lower its rate.
    """
    settings = Align(moving_rate=0.1)
    aligner = Aligner((BATTERY,), settings)
    aligner.telemetry("battpos", START - round(rests * SECOND), 0.0)
    aligner.telemetry("battpos", START, 0.0)
    at_us = START + round(seconds * SECOND)
    aligner.telemetry("battpos", at_us, change * settings.moving_rate * (BATTERY.high - BATTERY.low))
    assert ("moving" in flags(aligner.reading(reading(), at_us))) == moving


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 50.0])
@pytest.mark.parametrize(("speed", "moves"), [(0.0, False), (1.08, True), (2.0, True)])
def test_a_steady_motion_above_the_moving_rate_is_flagged_throughout(
    rate_hz: float, speed: float, *, moves: bool
) -> None:
    """The telemetry's jitter is 3 % of its period; its noise is 0.5 % of the range for a mass at rest."""
    aligner, rng = Aligner((BATTERY,), Align()), np.random.default_rng(1)
    noise = 0.0 if moves else 1e-3
    seen = []
    for k in range(round(20 * rate_hz)):
        t = (k + rng.uniform(0.0, 0.03)) / rate_hz
        aligner.telemetry("battpos", START + round(t * SECOND), 0.01 * speed * t + noise * rng.normal())
        seen.append("moving" in flags(aligner.reading(reading(), START + round((t + 0.01) * SECOND))))
    assert np.mean(seen[round(rate_hz) :]) == float(moves)


@pytest.mark.parametrize(
    ("interval", "delay", "lost"),
    [(0.25, 0.0, (8.0, 28.0)), (4.0, 0.0, (8.0, 28.0)), (0.2, 2.5, ()), (0.2, 0.0, (8.1, 12.0))],
    ids=["lost at 4 Hz", "lost at 0.25 Hz", "late", "silent"],
)
@pytest.mark.parametrize("start", [-0.6, -1.0], ids=["inside", "from end to end"])
def test_the_bounds_of_a_moving_mass_grow_until_its_telemetry_comes(
    interval: float, delay: float, lost: tuple[float, ...], start: float
) -> None:
    """The mass moves by 4 % of its range a second; its total field changes by 1 nT per unit."""
    aligner, began, z = Aligner((BATTERY,), Align()), 4.0, []

    def position(t: float) -> float:
        return min(start + 0.08 * max(t - began, 0.0), 1.0)

    reports = [t for t in np.arange(0.0, 28.0, interval) if not lost or not lost[0] < t < lost[1]]
    for t in np.arange(began + delay + 1.1 * interval, 28.0, 0.1):
        while reports and reports[0] + delay <= t:
            aligner.telemetry("battpos", START + round(reports[0] * SECOND), position(reports.pop(0)))
        sample = aligner.reading(reading(), START + round(t * SECOND))
        if "moving" in flags(sample):
            ((_, low, high),) = sample.spans
            assert -1.0 - 1e-9 <= min(low, high) <= max(low, high) <= 1.0 + 1e-9
            z.append((sample.values[0] - position(t)) / (0.5 * abs(high - low) + 1e-6))
    assert len(z) > 50
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_out_of_order_telemetry_is_ignored_and_of_several_at_once_the_newest_counts() -> None:
    aligner = Aligner((BATTERY,), Align(moving_rate=100.0))
    aligner.telemetry("battpos", START + SECOND, 0.2)
    aligner.telemetry("battpos", START, 0.9)
    aligner.telemetry("battpos", START + SECOND, 0.9)
    assert aligner.reading(reading(), START + 2 * SECOND).values == (0.9,)


@pytest.mark.parametrize("dated", [True, False])
@pytest.mark.parametrize("guessed", [True, False])
def test_what_waited_is_joined_with_the_telemetry_of_its_time(dated: bool, guessed: bool) -> None:
    """A mass goes from 0 to 1 within the 8 s of a standstill, and all that waited comes at once."""
    aligner = Aligner((BATTERY,), Align(moving_rate=100.0))
    aligner.telemetry("battpos", START, 0.0)
    end = START + 8 * SECOND
    aligner.late_since_us = START
    for k in range(1, 9):
        when = end if guessed else START + k * SECOND
        aligner.telemetry("battpos", when, float(k >= 3), guessed=guessed)
    for k in range(1, 9):
        one = reading(device_time=float(k)) if dated else reading()
        sample = aligner.reading(one, START + k * SECOND if dated else end + 4 * k)
        assert flags(sample) == ({"late_join"} if guessed or not dated else set())
        if dated and not guessed:
            assert sample.values == (float(k >= 3),)
        else:
            assert (0, 0.0, 1.0) in sample.spans
    aligner.late_since_us = 0
    assert "late_join" not in flags(aligner.reading(reading(), end + SECOND))


def test_a_reading_that_may_have_waited_is_joined_with_all_telemetry_since_then() -> None:
    aligner = Aligner((BATTERY,), Align(moving_rate=100.0))
    for k in range(9):
        aligner.telemetry("battpos", START + k * SECOND, float(k >= 3))
    sample = aligner.reading(reading(since_us=START + 2 * SECOND), START + 8 * SECOND)
    assert flags(sample) == {"late_join"}
    assert (0, 0.0, 1.0) in sample.spans


def test_of_a_time_within_the_standstill_whose_telemetry_has_not_come_nothing_is_known() -> None:
    aligner = Aligner((BATTERY,), Align())
    aligner.telemetry("battpos", START, 0.0)
    aligner.late_since_us = START
    assert flags(aligner.reading(reading(device_time=1.0), START + SECOND)) == {"late_join"}


@pytest.mark.parametrize("times", [[0, 4, 8, 12, 24, 28], [0, 5, 10, 15, 45, 75, 105, 110, 115]])
def test_missing_readings_are_a_gap_and_so_is_the_first_of_a_slower_rate(times: list[int]) -> None:
    aligner = Aligner((), Align())
    gaps = ["gap" in flags(aligner.reading(reading(), START + t * SECOND)) for t in times]
    assert gaps == [k == 4 for k in range(len(times))]
    assert "gap" in flags(aligner.reading(reading(missing=1), START + (times[-1] + 4) * SECOND))


def test_a_power_cycle_makes_the_offset_suspect_for_good() -> None:
    aligner = Aligner((), Align(turn_on_sigma=20.0), power_cycle=7)
    assert flags(aligner.reading(reading(power_cycle=7), START)) == set()
    after = aligner.reading(reading(power_cycle=8), START + 4 * SECOND)
    assert flags(after) == {"offset_suspect"}
    assert after.sigma == 20.0
    assert "offset_suspect" in flags(aligner.reading(reading(power_cycle=8), START + 8 * SECOND))


def test_a_saturated_sample_is_kept_with_infinite_sigma() -> None:
    sample = Aligner((), Align()).reading(reading(65000.0, saturated=True), START)
    assert flags(sample) == {"saturated"}
    assert sample.sigma == inf
    assert sample.field == (65000.0,) * 3


# ---- Channels sampled in turn: what a slope that is known late does to the field -------------------------


DELAYS = (0.0, 0.3, 0.7)


def turning(rate: float, acceleration: float, at: list[float]) -> list[tuple[float, float, float]]:
    """Return three channels of one field, nT, that changes ever faster, each at its own time."""
    return [tuple(30_000.0 + rate * t + 0.5 * acceleration * t * t for t in np.add(s, DELAYS)) for s in at]


def test_the_parabola_is_exact_where_the_field_turns_ever_faster_and_sigma_is_the_lag_of_the_slopes() -> None:
    """Steadily faster, a chord lies above the curve by d (h - d) / 2 of the acceleration."""
    channels, times, d = OneTime(), [3.0, 7.0, 11.0, 14.0], np.array(DELAYS)
    for k, (t, field) in enumerate(zip(times, turning(20.0, 3.0, times), strict=True)):
        out, _ = channels.bring(field, DELAYS, round(t * SECOND))
        truth = [30_000.0 + 20.0 * at + 1.5 * at**2 for at in times]
        if k < 2:
            assert channels.settled is None
            continue
        np.testing.assert_allclose(channels.settled, truth[k - 1], atol=1e-6)
        lag = 0.5 * 3.0 * d * (t - times[k - 1] - d)
        np.testing.assert_allclose(np.array(out) - truth[k], lag, atol=1e-6)
        if k == 2:  # as long an interval as the one before
            assert channels.variance == pytest.approx(np.sum(np.square(lag)) / 3.0, rel=3e-3)


@pytest.mark.parametrize("delays", [(0.0, 0.0, 0.0), (0.2, 0.2, 0.2)])
def test_channels_of_one_time_stay_as_they_are(delays: tuple[float, float, float]) -> None:
    channels = OneTime()
    for k in range(4):
        field = (1.0 + k * k, 2.0 * k, 3.0)
        assert channels.bring(field, delays, (k + 1) * SECOND) == (field, delays[0])
        assert (channels.variance, channels.settled) == (0.0, None)


def test_a_reading_without_a_channel_tells_nothing_of_its_neighbours() -> None:
    channels, times = OneTime(), [4.0, 8.0, 12.0, 16.0]
    readings = turning(20.0, 0.0, times)
    readings[2] = (readings[2][0], float("nan"), readings[2][2])
    out = [channels.bring(f, DELAYS, round(t * SECOND))[0] for t, f in zip(times, readings, strict=True)]
    assert np.isnan(out[2][1])
    expected = 30_000.0 + 20.0 * np.array([12, 12, 16, 16, 16])
    np.testing.assert_allclose([out[2][0], out[2][2], *out[3]], expected)
    np.testing.assert_allclose(channels.settled, 30_000.0 + 20.0 * 8.0)


def test_a_log_whose_channels_were_read_in_turn() -> None:
    """As live once the next reading is known; a row that stands twice, and a gap, harm none of the others."""
    time = np.array([3.0, 7.0, 7.0, 12.0, 15.0, 400.0, 404.0])
    read = [np.add(time, delay) for delay in DELAYS]
    columns: dict[str, tuple[str, np.ndarray]] = {}
    for axis, t in zip("xyz", read, strict=True):
        columns |= {
            f"mag_{axis}": ("time", 30_000.0 + 20.0 * t + 1.5 * t * t),
            f"mag_time_{axis}": ("time", t),
        }
    together = at_one_time(xr.Dataset(columns, coords={"time": time}))
    assert not any(str(name).startswith("mag_time") for name in together)
    truth = 30_000.0 + 20.0 * time + 1.5 * time * time
    for axis in "xyz":
        np.testing.assert_allclose(together[f"mag_{axis}"][3], truth[3], atol=1e-6)
        np.testing.assert_allclose(together[f"mag_{axis}"][:5], truth[:5], atol=30.0)
        assert np.isfinite(together[f"mag_{axis}"]).all()


def test_a_channel_that_repeats_a_reading_has_the_slope_of_those_before() -> None:
    """As one that is sampled more rarely: its time is that of the reading that it repeats."""
    channels = OneTime()
    for k in range(6):
        t = 4.0 * (k + 1)
        sampled = t - 4.0 * (k % 2)
        field = (30_000.0 + 20.0 * t, 30_000.0, 30_000.0 + 20.0 * sampled)
        out, after = channels.bring(field, (0.0, 0.0, sampled - t), round(t * SECOND))
        np.testing.assert_allclose(out, (30_000.0 + 20.0 * (t + after), 30_000.0, 30_000.0 + 20.0 * sampled))


def test_a_channel_of_a_log_is_brought_to_its_rows_by_the_cubic() -> None:
    time = np.array([0.0, 4.0, 8.0, 13.0, 16.0, 20.0, 24.0])
    sampled = time + DELAYS[1]

    def curve(t: np.ndarray) -> np.ndarray:
        return np.asarray(2e4 + 30.0 * t - 2.0 * t**2 + 0.1 * t**3)

    found, cubic = interpolate_to_rows(time, sampled, curve(sampled))
    np.testing.assert_allclose(found[2:-1], curve(time)[2:-1], atol=1e-8)
    assert list(np.isnan(cubic)) == [True, True, False, False, False, False, True]


def test_on_a_smooth_turn_a_late_channel_is_right_to_a_quarter_of_a_nanotesla() -> None:
    """One row every 4 s, 0.3 s late, 3 deg/s: the parabola alone is off by 2.2 nT."""
    time = 4.0 * np.arange(200.0)
    sampled = time + 0.3
    truth, read = 18_000.0 * np.cos(np.radians(3.0 * np.array([time, sampled])))
    found, cubic = interpolate_to_rows(time, sampled, read)
    inner = slice(3, -3)

    def error(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean((values - truth)[inner] ** 2)))

    assert error(found) < 0.3
    assert error(found - np.nan_to_num(cubic)) > 1.2
