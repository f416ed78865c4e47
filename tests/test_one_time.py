"""Channels sampled in turn: what a slope that is known late does to the field."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magbridge.calibration.fitting.observe import at_one_time
from magbridge.one_time import OneTime, interpolate_to_rows

SECOND = 1_000_000
DELAYS = (0.0, 0.3, 0.7)


def turning(rate: float, acceleration: float, at: list[float]) -> list[tuple[float, float, float]]:
    """Return three channels of one field, nT, that changes ever faster, each at its own time."""
    return [tuple(30_000.0 + rate * t + 0.5 * acceleration * t * t for t in np.add(s, DELAYS)) for s in at]


def test_the_parabola_is_exact_where_the_field_turns_ever_faster() -> None:
    channels, times = OneTime(), [3.0, 7.0, 12.0, 15.0]
    for k, (t, field) in enumerate(zip(times, turning(20.0, 3.0, times), strict=True)):
        channels.bring(field, DELAYS, round(t * SECOND))
        if k < 2:
            assert channels.settled is None
        else:
            truth = 30_000.0 + 20.0 * times[k - 1] + 1.5 * times[k - 1] ** 2
            np.testing.assert_allclose(channels.settled, truth, atol=1e-6)


def test_sigma_is_the_lag_of_the_slopes() -> None:
    """Steadily faster, a chord lies above the curve by d (h - d) / 2 of the acceleration."""
    channels, times, out = OneTime(), [4.0, 8.0, 12.0], (0.0, 0.0, 0.0)
    for t, field in zip(times, turning(20.0, 3.0, times), strict=True):
        out, _ = channels.bring(field, DELAYS, round(t * SECOND))
    d = np.array(DELAYS)
    lag = 0.5 * 3.0 * d * (4.0 - d)
    np.testing.assert_allclose(np.array(out) - (30_000.0 + 20.0 * 12.0 + 1.5 * 144.0), lag, atol=1e-6)
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
    np.testing.assert_allclose(
        [out[2][0], out[2][2], *out[3]], 30_000.0 + 20.0 * np.array([12, 12, 16, 16, 16])
    )
    np.testing.assert_allclose(channels.settled, 30_000.0 + 20.0 * 8.0)


def test_a_log_whose_channels_were_read_in_turn() -> None:
    """As live once the next reading is known; a row that stands twice, and a gap, harm none of the others."""
    time = np.array([3.0, 7.0, 7.0, 12.0, 15.0, 400.0, 404.0])
    read = [np.add(time, delay) for delay in DELAYS]
    field = {
        f"mag_{axis}": ("time", 30_000.0 + 20.0 * t + 1.5 * t * t)
        for axis, t in zip("xyz", read, strict=True)
    }
    times = {f"mag_time_{axis}": ("time", t) for axis, t in zip("xyz", read, strict=True)}
    together = at_one_time(xr.Dataset({**field, **times}, coords={"time": time}))
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


def test_channels_at_the_rows_times_are_not_changed() -> None:
    time, values = np.arange(5.0), np.array([1.0, np.nan, 3.0, 7.0, 1.0])
    np.testing.assert_array_equal(interpolate_to_rows(time, time, values)[0], values)
