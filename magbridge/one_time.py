r"""Channels that are sampled in turn, at one time: that of the earliest.

Channel i of reading k is sampled :math:`d` later than that. With its slope r since the reading before, h ago,
it was, by the parabola through that one and the next, h' later (in Newton's form),

.. math:: f_k - r_k\,d - \frac{d\,(h - d)}{h + h'} (r_{k+1} - r_k), \qquad r_k = \frac{f_k - f_{k-1}}{h}

Live, the next reading is not known. The last term, by which the slope lags behind a vehicle that turns ever
faster or slower, is left out then; what it was with the slope before counts in the sigma, and the next
reading settles it. That matters: the lag goes with the attitude, so to what is learned from it, it is no
noise but a bias.
"""

from __future__ import annotations

from math import isnan, nan

from magbridge.records import Vector

__all__ = ["OneTime"]


class OneTime:
    """Brings reading after reading to one time.

    Attributes
    ----------
    variance : float
        nT², of the last reading's total field: the lag of its slopes.
    settled : tuple of 3 float or None
        nT, the reading before the last without that lag; None where it is as it was.
    """

    def __init__(self) -> None:
        self.variance = 0.0
        self.settled: Vector | None = None
        self._us, self._step = 0, 0.0
        self._field, self._delay = (nan, nan, nan), (0.0, 0.0, 0.0)
        self._out, self._slope, self._lever = (nan, nan, nan), (nan, nan, nan), (nan, nan, nan)

    def bring(self, field: Vector, delay: Vector, time_us: int) -> tuple[Vector, float]:
        """Return a reading's channels at one time, and how long after `time_us` that is, s.

        Parameters
        ----------
        field : tuple of 3 float
            nT; one that is not all numbers tells nothing of those before and after.
        delay : tuple of 3 float
            s after `time_us`, when each was sampled.
        time_us : int
            µs.
        """
        x_late, y_late, z_late = delay
        earliest = min(x_late, min(y_late, z_late))  # noqa: PLW3301 - two numbers need no call
        x_late, y_late, z_late = x_late - earliest, y_late - earliest, z_late - earliest
        step = (time_us - self._us) * 1e-6
        out, slope, lever = field, (nan, nan, nan), (nan, nan, nan)
        self.variance, self.settled = 0.0, None
        x, y, z = field
        if self._us and step > 0.0 and (x_late or y_late or z_late):
            slope = x_slope, y_slope, z_slope = self._slopes(field, delay, step)
            out = x - x_slope * x_late, y - y_slope * y_late, z - z_slope * z_late
            lever = x_late * (step - x_late), y_late * (step - y_late), z_late * (step - z_late)
            self._judge(field, slope, lever, 1.0 / (step + self._step))
        if x + y + z == x + y + z:
            self._us, self._step, self._field, self._delay = time_us, step, field, delay
            self._out, self._slope, self._lever = out, slope, lever
        return out, earliest

    def _slopes(self, field: Vector, delay: Vector, step: float) -> Vector:
        """Return how fast each channel has changed since the reading before, nT/s."""
        x, y, z = field
        x_then, y_then, z_then = self._field
        x_late, y_late, z_late = delay
        x_was, y_was, z_was = self._delay
        x_slope, y_slope, z_slope = self._slope
        return (
            _slope(x - x_then, step + x_late - x_was, x_slope),
            _slope(y - y_then, step + y_late - y_was, y_slope),
            _slope(z - z_then, step + z_late - z_was, z_slope),
        )

    def _judge(self, field: Vector, slope: Vector, lever: Vector, share: float) -> None:
        """Set the lag that is to be expected, and the reading before without its own."""
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


def _slope(change: float, step: float, before: float) -> float:
    """Return a slope, nT/s: of a channel that was not read anew that of `before`, or 0 where it had none."""
    if step > 0.0:
        return change / step
    return 0.0 if isnan(before) else before
