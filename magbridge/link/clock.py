"""Offset of the autopilot's clock from the bridge's clock, estimated from TIMESYNC."""

from __future__ import annotations

from collections import deque
from math import nan, sqrt

__all__ = ["VehicleClock"]

CLOCK_EXCHANGES = 32
"""Latest exchanges that are used."""
JITTER_US = 200.0
"""Uncertainty of even the fastest exchange, µs."""
STEP_US, DRIFT = 20_000, 500e-6
"""µs, µs/µs: a clock was set if the offsets of two exchanges differ by more than half of both round trips,
plus this step, plus this drift over the time between them."""
SPAN_US = 10_000_000
"""µs that the exchanges must span before a drift is estimated."""
PENDING = 8


class VehicleClock:
    """Estimate ``offset = vehicle clock - bridge clock`` and its drift.

    Notes
    -----
    An exchange sent at ``ts``, answered with the vehicle's ``tc`` and received at ``tr`` gives
    ``offset = tc - (ts + tr) / 2``, wrong by no more than half its round trip ``tr - ts``. The time by which
    an exchange is slower than the fastest recent one was spent waiting, in an unknown direction. So a
    straight line is fitted to the last exchanges with the weights ``1 / sigma^2``, where
    ``sigma = JITTER + (rtt - min rtt) / 2`` (Cristian, 1989, uses the fastest alone).
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the vehicle's clock restarted or was set."""
        self._asked: deque[int] = deque(maxlen=PENDING)
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=CLOCK_EXCHANGES)
        self._base_us = self._middle_us = 0
        self._offset, self._slope = 0.0, 0.0
        self.sigma = nan

    @property
    def known(self) -> bool:
        """Return True if there is an estimate."""
        return bool(self._exchanges)

    @property
    def drift_ppm(self) -> float:
        """How much faster than ours the vehicle's clock runs; NaN while unknown."""
        return self._slope * 1e6 if self._slope else nan

    def ask(self, now_us: int) -> int:
        """Return the ``ts1`` (ns) of a request sent now."""
        self._asked.append(now_us * 1000)
        return now_us * 1000

    def answer(self, tc1: int, ts1: int, now_us: int) -> None:
        """Process an answer (ns) received at `now_us`; ignore answers to other components."""
        if ts1 not in self._asked:
            return
        self._asked.remove(ts1)
        sent_us = ts1 // 1000
        trip_us = now_us - sent_us
        middle_us = sent_us + trip_us // 2
        offset_us = tc1 // 1000 - middle_us
        if self.known:
            then_us, was_us, fastest_us = min(self._exchanges, key=lambda one: one[2])
            allowed_us = STEP_US + (trip_us + fastest_us) / 2 + DRIFT * (middle_us - then_us)
            if abs(offset_us - was_us) > allowed_us:
                self.reset()
        self._exchanges.append((middle_us, offset_us, trip_us))
        self._fit()

    def _fit(self) -> None:
        fastest = min(trip for _, _, trip in self._exchanges)
        self._middle_us, self._base_us, _ = self._exchanges[-1]
        s = sx = sy = sxx = sxy = 0.0
        for middle, offset, trip in self._exchanges:
            x, y = float(middle - self._middle_us), float(offset - self._base_us)
            weight = (JITTER_US + (trip - fastest) / 2) ** -2
            s += weight
            sx += weight * x
            sy += weight * y
            sxx += weight * x * x
            sxy += weight * x * y
        determinant = s * sxx - sx * sx
        self._slope = 0.0
        if self._middle_us - self._exchanges[0][0] >= SPAN_US and determinant > 0.0:
            self._slope = (s * sxy - sx * sy) / determinant
        self._offset = (sy - self._slope * sx) / s
        self.sigma = sqrt(1.0 / s) * 1e-6

    def offset_us(self, t_us: int) -> float:
        """Return the vehicle's clock minus ours at `t_us` (ours), in µs; 0 while unknown."""
        return self._base_us + (self._offset + self._slope * (t_us - self._middle_us))

    def bridge_time(self, vehicle_us: int, t_us: int, wrap_us: int = 0) -> int:
        """Return our time at which the vehicle's clock showed `vehicle_us`; at most `t_us`.

        Parameters
        ----------
        vehicle_us : int
            A time in a message.
        t_us : int
            When the message came.
        wrap_us : int
            µs after which the message's time field wraps to 0; 0: never.
        """
        offset_us = round(self.offset_us(t_us))
        if wrap_us:
            vehicle_us += round((t_us + offset_us - vehicle_us) / wrap_us) * wrap_us
        return min(vehicle_us - offset_us, t_us)
