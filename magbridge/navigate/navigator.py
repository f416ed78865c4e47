"""The navigator: telemetry and corrected samples in, in the order of their time; a position with its doubt out.

Pure in event time, with nothing random in it: a replay gives the same bits. ::

    nav = Navigator(read_grid("grid.nc"), Options(start_sigma=100.0))
    nav.fix(t_us, latitude, longitude)
    nav.telemetry(t_us, heading=90.0, speed=0.35, depth=40.0)
    record = nav.sample(t_us, corrected)        # None until enough samples make a measurement
    print(record.latitude, record.longitude, record.state.name)
"""

from __future__ import annotations

from enum import IntEnum
from math import inf, isfinite, log, nan, sqrt
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from magbridge.field.earth import offset, separation, wrap
from magbridge.field.grid import AnomalyGrid
from magbridge.field.nearby import NearbyField
from magbridge.navigate.bank import Bank, widest
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, Options, block_length, prior, resolution, transition
from magbridge.navigate.tracker import Tracker
from magbridge.navigate.watch import Unmapped, Verdict, Watch, distance
from magbridge.records import Corrected, Quality

__all__ = ["Navigator", "Record", "State"]

Array = NDArray[np.float64]

UNUSABLE = int(Quality.SATURATED | Quality.UNCALIBRATED)
CONTRADICTION = 25.0  # squared distance of a fix, two degrees of freedom: 4e-6 by chance
UNINFORMED = 0.8  # of what dead reckoning alone would have: the field has said nothing
REACH = 300.0  # m, the least that the watch looks around
JOIN, SPLIT = 1.2, 1.5  # of the map's resolution: below one hypothesis will do, above it will not
LEVEL_LASTS = 10.0  # times as long as a calibration's bias
DOUBTFUL = 1.0  # log odds: another place explains the field better, if not yet beyond doubt
SPREADS = (2.0, 4.0, 2.0, 8.0)  # times its reach, of the searches after each other
DOUBTED = 2  # searches in vain, after which the map's level is doubted too


class State(IntEnum):
    """What the filter says of itself; the values are those of the link."""

    OFF = 0
    """No start yet."""
    SEARCHING = 1
    """Several hypotheses."""
    TRACKING = 2
    """One hypothesis holds."""
    DEAD_RECKONING = 3
    """Off the map, or the field says nothing here."""
    LOST = 4
    """The field and the map disagree, or agree better elsewhere."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One update.

    Attributes
    ----------
    time_us : int
        µs since 1970 UTC, at which the rest holds: the mean time of the samples that went in.
    state : State
    vouched : bool
        The filter stands by this position: it may be sent as a fix.
    latitude, longitude : float
        deg.
    covariance_nn, covariance_ne, covariance_ee : float
        m², of the position.
    innovation, innovation_variance : float
        nT, nT²; measured minus expected anomaly; NaN off the map.
    gate : float
        Largest innovation squared over variance that is taken in.
    accepted : bool
        The measurement was taken in.
    anomaly : float
        nT, measured: total field minus main field at the dead-reckoned position.
    map_anomaly : float
        nT, of the map at the position; NaN off the map.
    bias, bias_sigma : float
        nT, of the calibration.
    map_error : float
        nT.
    current_north, current_east : float
        m/s.
    north, east : float
        m, from the dead-reckoned position.
    hypotheses : int
    odds : float
        Natural logarithm of the odds of another place against this one.
    """

    time_us: int
    state: State
    vouched: bool
    latitude: float
    longitude: float
    covariance_nn: float
    covariance_ne: float
    covariance_ee: float
    innovation: float
    innovation_variance: float
    gate: float
    accepted: bool
    anomaly: float
    map_anomaly: float
    bias: float
    bias_sigma: float
    map_error: float
    current_north: float
    current_east: float
    north: float
    east: float
    hypotheses: int
    odds: float


class Jump(NamedTuple):
    """The estimate began anew: µs, metres from where it was, 1-sigma that dead reckoning alone allowed, why."""

    time_us: int
    north: float
    east: float
    allowed: float
    cause: str


class Sums(NamedTuple):
    """What the samples of the block so far add up to, relative to the first of them."""

    start_us: int
    latitude: float
    longitude: float
    travelled: float
    n: int = 0
    time: int = 0
    d_latitude: float = 0.0
    d_longitude: float = 0.0
    anomaly: float = 0.0
    variance: float = 0.0
    slope_north: float = 0.0
    slope_east: float = 0.0


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
        self._reckoning, self._main_field = DeadReckoning(), NearbyField()
        self._step = min(block_length(grid), 1e6)
        self._sums: Sums | None = None
        self._time_us, self._latest_us, self._travelled = 0, 0, 0.0
        self._filter: Tracker | Bank | None = None
        self._watch: Watch | None = None
        self._unmapped = Unmapped(grid, self.options)
        self._nowhere = 0.0
        self._resolution = inf
        self._alone = self.P[:4, :4].copy()  # covariance of dead reckoning alone
        self._lost = False
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
        s = self._sums or Sums(time_us, where.latitude, where.longitude, where.travelled)
        main, slope_north, slope_east = self._main_field.at(
            where.latitude, where.longitude, where.depth, time_us * 1e-6
        )
        self._sums = Sums(
            s.start_us,
            s.latitude,
            s.longitude,
            s.travelled,
            s.n + 1,
            s.time + time_us - s.start_us,
            s.d_latitude + where.latitude - s.latitude,
            s.d_longitude + wrap(where.longitude - s.longitude),
            s.anomaly + total_field - main,
            s.variance + sigma * sigma,
            s.slope_north + slope_north,
            s.slope_east + slope_east,
        )
        full = (
            time_us - s.start_us >= self.options.interval * 1e6 or where.travelled - s.travelled >= self._step
        )
        return self.finish() if full else None

    def finish(self) -> Record | None:
        """Return the update of the samples that wait for more to join them; None if none wait."""
        s, self._sums = self._sums, None
        return None if s is None else self._update(s)

    # ---- one update ----------------------------------------------------------------------------------

    def _block(self, s: Sums) -> Block:
        n, o = s.n, self.options
        variance = s.variance / n
        white = variance if o.noise is None else min(o.noise**2, variance)
        return Block(
            s.start_us + s.time // n,
            s.latitude + s.d_latitude / n,
            wrap(s.longitude + s.d_longitude / n),
            s.anomaly / n,
            white / n + (variance - white),
            s.slope_north / n,
            s.slope_east / n,
        )

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

    def _update(self, s: Sums) -> Record:
        block = self._block(s)
        seconds, metres = self._predict(block.time_us)
        if self._filter is None:
            self._resolution = resolution(self.grid, block.variance)
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
        return Record(
            block.time_us,
            self.state,
            self.state is State.TRACKING and odds < DOUBTFUL and widest(self.P) < self.options.vouch_sigma,
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
            return (seen.value, seen.variance, seen.log_likelihood, seen.accepted, seen.anomaly) if seen else (
                nan, nan, 0.0, False, nan
            )  # fmt: skip
        assert self._filter is not None
        innovation, variance, likelihood = self._filter.update(block)
        best = self._filter.x[int(self._filter.w.argmax())]
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
        self._nowhere = max(
            self._nowhere + self._unmapped.update(block, seconds, metres) - likelihood,
            -log(self.options.doubt),
        )
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
            self._filter, self._watch = (
                Bank(self.grid, self.x, self.P, self._resolution, self.options.gate),
                None,
            )
        if self._lost:
            self.state = State.LOST
        elif not self._compact(width):
            self.state = State.SEARCHING
        elif not on_the_map or width > UNINFORMED * widest(self._alone):
            self.state = State.DEAD_RECKONING
        else:
            self.state = State.TRACKING
