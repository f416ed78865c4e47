r"""Interpolate channels that are sampled in turn to the time of the earliest channel.

Channel i of reading k is sampled :math:`d` later than that. With its slope r since the reading before, h ago,
it was, by the parabola through that one and the next, h' later (in Newton's form),

.. math:: f_k - r_k\,d - \frac{d\,(h - d)}{h + h'} (r_{k+1} - r_k), \qquad r_k = \frac{f_k - f_{k-1}}{h}

With a whole log, :func:`interpolate_to_rows` adds the cubic term.

A live bridge does not know the next reading. :class:`OneTime` leaves the last term out and counts its value
for the previous slope in the sigma; the next reading corrects the sample. Learning uses the corrected sample,
because the error depends on the attitude and would bias it.
"""

from __future__ import annotations

from math import isnan, nan

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.records import NEVER, Vector

__all__ = ["OneTime", "interpolate_to_rows"]

MAX_INTERVAL_RATIO = 10.0
"""Interval over the one next to it, beyond which it is a gap: the curve across it is not determined."""


def interpolate_to_rows(
    time: FloatArray, sampled: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    r"""Interpolate a channel that was sampled at other times than the rows to the rows' times.

    Parameters
    ----------
    time : (n,) array
        Time of each row, s.
    sampled : (n,) array
        When the channel was sampled, s. A time that is not later than those before repeats a reading.
    values : (n,) array
        The readings.

    Returns
    -------
    interpolated : (n,) array
        At the rows' times; NaN where the channel has no number or no time.
    cubic : (n,) array
        The cubic term in it; NaN at the ends, next to gaps and for repeated readings, where fewer readings
        determine the curve.

    Notes
    -----
    The cubic through the readings k-2 to k+1 in Newton's form, with divided differences
    (Press et al. 2007, Numerical recipes, section 3.2),

    .. math:: f_k + r_k (t - s_k) + b_k (t - s_k)(t - s_{k-1}) + c_k (t - s_k)(t - s_{k-1})(t - s_{k+1}).

    On a smooth turn with one row every 4 s and one channel 0.3 s late, its error is 0.25 nT, where the
    parabola of the first three terms is off by 2.2 nT.
    """
    out, cubic = np.full(len(time), np.nan), np.full(len(time), np.nan)
    known = np.isfinite(sampled) & np.isfinite(values)
    s_all, f_all, t = sampled[known], values[known], time[known]
    if len(t) < 2 or np.array_equal(s_all, t):
        out[known], cubic[known] = f_all, 0.0
        return out, cubic
    fresh = np.append(True, s_all[1:] > np.maximum.accumulate(s_all)[:-1])
    reading = np.cumsum(fresh) - 1  # the reading k of each row
    s, f = s_all[fresh], f_all[fresh]
    if len(s) < 2:
        out[known] = f_all
        return out, cubic
    h = np.diff(s)
    slopes = np.diff(f) / h
    r = np.append(slopes[0], slopes)
    # second divided differences b_k of readings k-1, k, k+1; zero across a gap
    b, c = np.zeros(len(s)), np.full(len(s), np.nan)
    b[1:-1] = np.diff(slopes) / (h[1:] + h[:-1])
    b[1:-1][h[1:] > MAX_INTERVAL_RATIO * h[:-1]] = 0.0
    # third divided differences c_k of readings k-2 to k+1; none where one of the intervals is a gap
    three = np.stack([h[:-2], h[1:-1], h[2:]])
    even = three.max(axis=0, initial=0.0) <= MAX_INTERVAL_RATIO * three.min(axis=0, initial=np.inf)
    c[2:-1] = np.where(even, (b[2:-1] - b[1:-2]) / three.sum(axis=0), np.nan)
    late = t - s[reading]
    before = t - np.append(s[0] - h[0], s[:-1])[reading]
    after = t - np.append(s[1:], s[-1] + h[-1])[reading]
    cubic[known] = np.where(fresh, c[reading] * late * before * after, np.nan)
    parabola = f[reading] + r[reading] * late + b[reading] * late * before
    out[known] = parabola + np.nan_to_num(cubic[known])
    return out, cubic


class OneTime:
    """Bring the channels of each reading to one time.

    `variance` (nT²) is the variance of the last reading's total field due to the missing last term;
    `settled` is the reading before it with that term (nT), None if it is unchanged.
    """

    def __init__(self) -> None:
        self.variance = 0.0
        self.settled: Vector | None = None
        self._us, self._step = NEVER, 0.0
        self._field, self._delay = (nan, nan, nan), (0.0, 0.0, 0.0)
        self._out, self._slope, self._lever = (nan, nan, nan), (nan, nan, nan), (nan, nan, nan)

    def bring(self, field: Vector, delay: Vector, time_us: int) -> tuple[Vector, float]:
        """Return a reading's channels at one time, and how long after `time_us` (µs) that is, s.

        `field` (nT) does not enter the slopes if a channel is not a number; `delay` is the time from
        `time_us` to the sample of each channel, s.
        """
        x_late, y_late, z_late = delay
        earliest = min(x_late, y_late, z_late)
        x_late, y_late, z_late = x_late - earliest, y_late - earliest, z_late - earliest
        step = (time_us - self._us) * 1e-6
        out, slope, lever = field, (nan, nan, nan), (nan, nan, nan)
        self.variance, self.settled = 0.0, None
        x, y, z = field
        if self._us != NEVER and step > 0.0 and (x_late or y_late or z_late):
            (x_then, y_then, z_then), (x_was, y_was, z_was), before = self._field, self._delay, self._slope
            x_slope = _slope(x - x_then, step + delay[0] - x_was, before[0])
            y_slope = _slope(y - y_then, step + delay[1] - y_was, before[1])
            z_slope = _slope(z - z_then, step + delay[2] - z_was, before[2])
            slope = x_slope, y_slope, z_slope
            out = x - x_slope * x_late, y - y_slope * y_late, z - z_slope * z_late
            lever = x_late * (step - x_late), y_late * (step - y_late), z_late * (step - z_late)
            self._judge(field, slope, lever, 1.0 / (step + self._step))
        if x + y + z == x + y + z:
            self._us, self._step, self._field, self._delay = time_us, step, field, delay
            self._out, self._slope, self._lever = out, slope, lever
        return out, earliest

    def _judge(self, field: Vector, slope: Vector, lever: Vector, share: float) -> None:
        """Set the variance by the expected lag, and the previous reading without its lag."""
        (x, y, z), (x_lever, y_lever, z_lever), (x_was, y_was, z_was) = field, lever, self._lever
        before = self._slope
        dx, dy, dz = slope[0] - before[0], slope[1] - before[1], slope[2] - before[2]
        dx, dy, dz = share * dx, share * dy, share * dz
        x_lag, y_lag, z_lag = x * x_lever * dx, y * y_lever * dy, z * z_lever * dz
        square = x_lag * x_lag + y_lag * y_lag + z_lag * z_lag
        length = x * x + y * y + z * z
        # NaN with the second reading and an invalid channel; zero where the sensor reads 0, 0, 0
        if square >= 0.0 and length > 0.0:
            self.variance = square / length
            x, y, z = self._out
            self.settled = x - x_was * dx, y - y_was * dy, z - z_was * dz


def _slope(change: float, step: float, previous: float) -> float:
    """Return a slope, nT/s: for a channel that was not read again that of `previous`, or 0 if it had none."""
    if step > 0.0:
        return change / step
    return 0.0 if isnan(previous) else previous
