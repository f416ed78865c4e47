"""The navigator: telemetry and corrected samples in, in the order of their time; a position with its doubt out.

Pure in event time, with nothing random in it: a replay gives the same bits. ::

    nav = Navigator(read_grid("grid.nc"), Options(start_sigma=100.0))
    nav.fix(t_us, latitude, longitude)
    nav.telemetry(t_us, heading=90.0, speed=0.35, depth=40.0)
    record = nav.sample(t_us, corrected)        # None until enough samples make a measurement
    print(record.latitude, record.longitude, record.state.name)
"""

from __future__ import annotations

from math import inf, isfinite, log, nan, sqrt

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from magbridge.field.earth import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank, widest
from magbridge.navigate.collect import Collector
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, Options, block_length, prior, resolution, transition
from magbridge.navigate.record import Jump, Reckoned, Record, State
from magbridge.navigate.tracker import Tracker
from magbridge.navigate.watch import Unmapped, Verdict, Watch, distance
from magbridge.records import Corrected, Quality

__all__ = ["UNUSABLE", "Navigator"]

Array = NDArray[np.float64]

UNUSABLE = int(Quality.SATURATED | Quality.UNCALIBRATED)
CONTRADICTION = 25.0  # squared distance of a fix, two degrees of freedom: 4e-6 by chance
UNINFORMED = 0.8  # of what dead reckoning alone would have: the field has said nothing
REACH = 300.0  # m, the least that the watch looks around
JOIN, SPLIT = 1.2, 1.5  # of the map's resolution: below one hypothesis will do, above it will not
FRESH = 3.0  # intervals: an update older than that is not followed by others
FINER = 0.8  # of the resolution: so much better a measurement must be to be worth a finer one
LEVEL_LASTS = 10.0  # times as long as a calibration's bias
DOUBTFUL = 1.0  # log odds: another place explains the field better, if not yet beyond doubt
SPREADS = (2.0, 4.0, 2.0, 8.0)  # times its reach, of the searches after each other
DOUBTED = 2  # searches in vain, after which the map's level is doubted too


class Navigator:
    """Position from the total field and a map, around a dead-reckoned track.

    Parameters
    ----------
    grid : AnomalyGrid
    options : Options, optional

    Attributes
    ----------
    state : State
    x, P : ndarray, (6,), (6, 6)
        Estimate and covariance, of :mod:`~magbridge.navigate.model`'s states.
    moved : tuple of ndarray
        F and Q from the record before to the last one, for a smoother.
    jumps : list of Jump
        Where the estimate began anew; a smoother must not look across.
    dropped : int
        Samples that came out of the order of their time.
    """

    def __init__(self, grid: AnomalyGrid, options: Options | None = None) -> None:
        self.grid, self.options = grid, options or Options()
        self.state = State.OFF
        self.x, self.P = prior(self.options)
        self.moved = np.eye(6), np.zeros((6, 6))
        self._reported = False
        self.jumps: list[Jump] = []
        self.dropped = 0
        self._reckoning = DeadReckoning()
        self._collector = Collector(self.options, block_length(grid))
        self._time_us, self._latest_us, self._travelled = 0, 0, 0.0
        self._filter: Tracker | Bank | None = None
        self._watch: Watch | None = None
        self._unmapped = Unmapped(grid, self.options)
        self._nowhere = 0.0
        self._resolution = inf
        self._alone = self.P[:4, :4].copy()  # covariance of dead reckoning alone
        self._lost = self._vouched = False
        self._searches = 0

    # ---- what comes in -------------------------------------------------------------------------------

    def fix(
        self, time_us: int, latitude: float, longitude: float, sigma: float | None = None
    ) -> Record | None:
        """Take in a position from elsewhere: the start, or a GPS fix; return the update that it completes.

        Parameters
        ----------
        sigma : float, optional
            m, each axis; default ``options.start_sigma``.
        """
        if not (isfinite(latitude) and isfinite(longitude)):
            return None
        sigma = self.options.start_sigma if sigma is None else sigma
        self._reckoning.advance(time_us * 1e-6)
        if self._filter is None:
            self._reckoning.place(latitude, longitude)
            self._collector.flush()  # of samples that were taken at another place
            self._time_us = time_us
            self.x, self.P = prior(self.options, sigma)
            self._alone = self.P[:4, :4].copy()
            self.state = State.SEARCHING
            return None
        record = self.finish()
        self._predict(time_us)
        self._estimate()
        there = np.array(separation(self._reckoning.latitude, self._reckoning.longitude, latitude, longitude))
        if distance(there - self.x[:2], self.P[:2, :2] + sigma**2 * np.eye(2)) > CONTRADICTION:
            _, start = prior(self.options, sigma)
            start[2:, 2:] += self.P[2:, 2:]
            self._begin(np.concatenate([there, self.x[2:]]), start, "a fix contradicts the filter")
        else:
            self._filter.update_position(float(there[0]), float(there[1]), sigma)
            self._estimate()
        self._watch, self._lost = None, False
        self._alone = np.diag([sigma**2, sigma**2, *np.diag(self.P)[2:4]])
        return record

    def telemetry(self, time_us: int, **values: float) -> None:
        """Take in telemetry for dead reckoning, named as :meth:`DeadReckoning.telemetry` has it."""
        self._reckoning.telemetry(time_us * 1e-6, values)

    def sample(self, time_us: int, corrected: Corrected) -> Record | None:
        """Take in a corrected sample; return the update that it completes, if it does."""
        if corrected.quality & UNUSABLE:
            return None
        return self.measure(time_us, corrected.total_field, corrected.total_field_sigma)

    def measure(self, time_us: int, total_field: float, sigma: float) -> Record | None:
        """Take in a total field and its 1-sigma, nT; return the update that it completes, if it does.

        What is NaN, older than the sample before, or comes before any position is passed over.
        """
        if self.state is State.OFF or not isfinite(total_field + sigma):
            return None
        if time_us <= self._latest_us:
            self.dropped += 1
            return None
        self._latest_us = time_us
        where = self._reckoning
        where.advance(time_us * 1e-6)
        block = self._collector.add(time_us, where, total_field, sigma)
        return None if block is None else self._update(block)

    def finish(self) -> Record | None:
        """Return the update of the samples that wait for more to join them; None if none wait."""
        block = self._collector.flush()
        return None if block is None else self._update(block)

    def reckon(self, time_us: int) -> Reckoned | None:
        """Return the position at a time since the last update, dead-reckoned from there; nothing is changed.

        None if the filter does not vouch for it: the last update was not vouched for, or is too long ago.
        """
        elapsed = (time_us - self._time_us) * 1e-6
        if not self._vouched or elapsed > FRESH * self.options.interval:
            return None
        F, Q = transition(self.options, max(elapsed, 0.0), 0.0)
        x, P = F @ self.x, F @ self.P @ F.T + Q
        if widest(P) > self.options.vouch_sigma:
            return None
        place = offset(*self._reckoning.ahead(time_us * 1e-6), float(x[0]), float(x[1]))
        (nn, ne), (_, ee) = P[:2, :2].tolist()
        return Reckoned(time_us, *place, nn, ne, ee)

    # ---- one update ----------------------------------------------------------------------------------

    def _predict(self, time_us: int) -> tuple[float, float]:
        """Move every estimate on to `time_us`; return the seconds and metres that it took."""
        seconds, metres = (time_us - self._time_us) * 1e-6, self._reckoning.travelled - self._travelled
        self._time_us, self._travelled = time_us, self._reckoning.travelled
        F, Q = transition(self.options, seconds, metres)
        self._alone = F[:4, :4] @ self._alone @ F[:4, :4].T + Q[:4, :4]
        self.moved = (F, Q) if self._reported else (F @ self.moved[0], F @ self.moved[1] @ F.T + Q)
        self._reported = False
        if self._filter is None:
            self.x, self.P = F @ self.x, F @ self.P @ F.T + Q
        else:
            self._filter.predict(F, Q)
        return seconds, metres

    def _update(self, block: Block) -> Record:
        seconds, metres = self._predict(block.time_us)
        finer = resolution(self.grid, self.options, block.variance)
        if finer < FINER * self._resolution:  # a first block may be a bad one, and says nothing of the rest
            self._resolution = finer
            if isinstance(self._filter, Bank):
                self._filter.finest = finer
        if self._filter is None:
            self._filter = self._estimator(self.x, self.P)
        innovation, variance, likelihood, accepted, anomaly = self._take_in(block)
        self._estimate()
        if isfinite(anomaly):
            self._judge(block, seconds, metres, likelihood)
        self._choose(isfinite(anomaly))
        self._reported = True
        latitude, longitude = offset(block.latitude, block.longitude, float(self.x[0]), float(self.x[1]))
        (nn, ne), (_, ee) = self.P[:2, :2].tolist()
        odds = self._watch.odds if self._watch else 0.0
        sure = widest(self.P) < self.options.vouch_sigma
        self._vouched = self.state is State.TRACKING and odds < DOUBTFUL and sure
        return Record(
            block.time_us,
            self.state,
            self._vouched,
            latitude,
            longitude,
            nn,
            ne,
            ee,
            innovation,
            variance,
            self.options.gate,
            accepted,
            block.anomaly,
            anomaly,
            float(self.x[4]),
            sqrt(self.P[4, 4]),
            float(self.x[5]),
            float(self.x[2]),
            float(self.x[3]),
            float(self.x[0]),
            float(self.x[1]),
            len(self._filter) if isinstance(self._filter, Bank) else 1,
            odds,
        )

    def _take_in(self, block: Block) -> tuple[float, float, float, bool, float]:
        """Return innovation, its variance, log-likelihood, whether it was taken in, and the map's anomaly."""
        if isinstance(self._filter, Tracker):
            seen = self._filter.update(block)
            if seen is None:
                return nan, nan, 0.0, False, nan
            return seen.value, seen.variance, seen.log_likelihood, seen.accepted, seen.anomaly
        assert self._filter is not None
        innovation, variance, likelihood = self._filter.update(block)
        best = self._filter.x[:, int(self._filter.w.argmax())]
        latitude, longitude = offset(block.latitude, block.longitude, float(best[0]), float(best[1]))
        anomaly = self.grid.look_up(longitude, latitude).anomaly
        accepted = innovation**2 <= self.options.gate * variance
        return innovation, variance, likelihood, accepted, anomaly

    def _estimate(self) -> None:
        if isinstance(self._filter, Bank):
            self.x, self.P = self._filter.moments()
        elif self._filter is not None:
            self.x, self.P = self._filter.x, self._filter.P

    # ---- one hypothesis or many, and whether to believe them -----------------------------------------

    def _estimator(self, x: Array, P: Array) -> Tracker | Bank:
        """Return one hypothesis, or as many as it takes."""
        if widest(P) < SPLIT * self._resolution:
            return Tracker(self.grid, x, P, self.options.gate)
        return Bank(self.grid, x, P, self._resolution, self.options.gate)

    def _begin(self, x: Array, P: Array, cause: str) -> None:
        """Start again from a Gaussian."""
        self._jump(x, cause)
        self._filter, self.x, self.P = self._estimator(x, P), x, P

    def _jump(self, x: Array, cause: str) -> None:
        north, east = (x[:2] - self.x[:2]).tolist()
        self.jumps.append(Jump(self._time_us, north, east, widest(self._alone), cause))
        self._watch = None

    def _judge(self, block: Block, seconds: float, metres: float, likelihood: float) -> None:
        """Compare the filter with its rivals; leave it where one of them has won."""
        assert self._filter is not None
        unmapped = self._unmapped.update(block, seconds, metres, self._filter.blur)
        self._nowhere = max(self._nowhere + unmapped - likelihood, -log(self.options.doubt))
        if self._nowhere > log(self.options.doubt):
            self._search_anew()
            return
        if not self._compact(widest(self.P)):
            return
        if self._watch is None:
            reach = self._reach() * (2.0 if self._lost else 1.0)
            self._watch = Watch(
                self.grid, self.options, self.x, self.P, block.time_us, reach, self._resolution
            )
            return
        verdict = self._watch.step(block, metres, self.x, self.P)
        if verdict is Verdict.ELSEWHERE:
            self._filter, self._lost = self._watch.surrender(block.time_us), True
            self._jump(self._filter.moments()[0], verdict.value)
            self._estimate()
        elif verdict is Verdict.HOLDS:
            self._watch = None
            if self._nowhere < -0.5 * log(self.options.doubt):  # and the map does describe the field
                self._lost, self._searches = False, 0

    def _search_anew(self) -> None:
        """Look around, further, and then for a map of another level."""
        self._nowhere, self._lost = 0.0, True
        if self._searches == DOUBTED and self.options.bias_sigma < self.grid.rms:
            self.options = replace(
                self.options, bias_sigma=self.grid.rms, bias_time=LEVEL_LASTS * self.options.bias_time
            )
        self._unmapped = Unmapped(self.grid, self.options)
        x, P = prior(self.options)
        P[:4, :4] = self._alone
        P[:2, :2] += (self._reach() * SPREADS[self._searches % len(SPREADS)]) ** 2 * np.eye(2)
        self._searches += 1
        self._begin(x, P, Verdict.NOWHERE.value)

    def _compact(self, width: float) -> bool:
        """Return whether a position of this spread is one place, seen on the scale of the map."""
        return width <= max(SPLIT * self._resolution, 0.25 * self.grid.correlation_length)

    def _reach(self) -> float:
        """Return how far around itself the filter is doubted: m."""
        alone = widest(self._alone)
        return max(REACH, alone, min(0.5 * self.grid.correlation_length, 5.0 * REACH))

    def _choose(self, on_the_map: bool) -> None:
        """Hand over from the bank to one filter, or back; and say what holds."""
        width = widest(self.P)
        if isinstance(self._filter, Bank) and width < JOIN * self._resolution:
            self._filter = Tracker(self.grid, self.x, self.P, self.options.gate)
        elif isinstance(self._filter, Tracker) and width > SPLIT * self._resolution:
            self._filter = Bank(self.grid, self.x, self.P, self._resolution, self.options.gate)
            self._watch = None
        if self._lost:
            self.state = State.LOST
        elif not self._compact(width):
            self.state = State.SEARCHING
        elif not on_the_map or width > UNINFORMED * widest(self._alone):
            self.state = State.DEAD_RECKONING
        else:
            self.state = State.TRACKING
