"""Integrity of GNSS positions: each is tested before the navigator uses it.

A jammed or spoofed receiver can still report a 3-D fix with a small error. The monitor rejects positions for
these reasons:

=========== ============================================================================================
jump        two positions differ by more than dead reckoning and its errors allow between them
frozen      the position stays the same while the vehicle moves
position    the difference from the navigator's position exceeds the errors of both
field       the map does not describe the measured field at the position
spoofing,   the receiver reports it (GNSS_INTEGRITY)
jamming
=========== ============================================================================================

All positions are relative to the dead-reckoned position. The difference of two right positions is then the
error of dead reckoning between them, for any motion of the vehicle.
"""

from __future__ import annotations

from collections import deque
from enum import IntEnum
from math import exp, hypot, inf, log, sqrt
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank
from magbridge.navigate.deadreckoning import MotionNoise, Step
from magbridge.navigate.integrity import Competitor, Unmapped, squared_mahalanobis
from magbridge.navigate.model import NO_MOTION_NOISE, Block, changed_variance, prior, transition
from magbridge.navigate.options import NavigationOptions, wider_level
from magbridge.navigate.record import Rival
from magbridge.records import NEVER

__all__ = ["UNSTATED_SIGMA_M", "GnssMonitor", "GnssReason", "GnssState", "Prediction"]

MAX_DEVIATION_SIGMA = 4.5
"""Largest accepted deviation from a prediction, in sigmas; 4e-5 of right positions exceed it by chance (two
degrees of freedom)."""
MIN_SIGMA_M = 1.5
"""Lower limit of a claimed position sigma, m: a receiver's error changes slowly."""
UNSTATED_SIGMA_M = 6.0
"""1-sigma on each axis of a receiver that states no accuracy, m: at the worst site, GPS alone errs by at most
15 m for 95 % of the time (GPS SPS performance standard 2020, table 3.8-3)."""
MAX_RETURN_SIGMA, MAX_HOLD_US = 2.0, 180_000_000
"""Largest change of the positions against dead reckoning, in its sigmas, with which rejected positions are
used again; 14 % of right changes exceed it by chance. The limit holds for the second value, in µs, because a
change of the current may last."""
WINDOW_US = 30_000_000
"""Time over which the motion by GNSS is compared with dead reckoning, µs."""
HOLD_US, LONG_HOLD_US = 20_000_000, 45_000_000
"""Time for which rejected positions must agree with each other before they are used again, µs: if navigator
or field confirms them, and if neither can."""
MAX_SIGMA_RATIO = 3.0
"""Largest sigma of a position over the smallest in WINDOW_US: a jammed receiver's claim varies widely."""
RIVAL_HOLD_US = 5_000_000
"""Time for which rejected positions must agree with each other before they may be right, µs."""
MIN_POSITIONS = 3
"""Smallest number of positions that must agree with each other in HOLD_US."""
OUTAGE_US = 60_000_000
"""Time without a position after which dead reckoning may err by more than ``current_sigma``, µs."""
OUTAGE_SPEED_FRACTION = 0.1
"""1-sigma of the velocity error after an outage, as a fraction of the speed."""
MIN_FROZEN_M = 10.0
"""Smallest distance that the vehicle must move before an unchanged position counts as frozen, m."""
MAX_GNSS_AGE_US = 10_000_000
"""Largest age of a usable position or integrity report, µs."""
CORRELATION_TIME_S = 30.0
"""Correlation time of the errors of successive positions that are fused, s."""
JITTER_TIME_S = 5.0
"""Shortest correlation time of these errors in the comparison with the field, s, and that of an error of
MIN_SIGMA_M: with a longer one, their white part would count as evidence against the positions."""
SEPARATION_TIME_S, SEPARATION_INTERVAL_S = 240.0, 80.0
"""Time for which a comparison filter runs without the positions, and time from the start of one to the start
of the next, s: one of them began shortly before a carry-off does."""
MIN_SEPARATION_S = 20.0
"""Smallest time without the positions of the filter that replaces the navigator's, s: in less, no test but
that by the field finds a fault."""
PRIOR_ODDS_WRONG = 0.2
"""Odds of wrong positions since the start of a comparison filter, before the field is compared."""
RECENT_POSITIONS = 64
"""Number of recent positions, from which the position at a measurement is interpolated."""
OK_STATE, DETECTED_STATE = 1, 3
"""Values of GPS_JAMMING_STATE and GPS_SPOOFING_STATE: OK, and detected but not mitigated."""


class GnssState(IntEnum):
    """Use of the receiver's positions; the values are those sent over the link."""

    NONE = 0
    """The receiver has sent no position."""
    GOOD = 1
    """The navigator uses the positions."""
    SUSPECT = 2
    """The navigator does not use the positions, although they could be right."""
    REJECTED = 3
    """The navigator rejects the positions as wrong."""


class GnssReason(IntEnum):
    """Reason for which positions are not used; the values are those sent over the link."""

    NONE = 0
    SPOOFING = 1
    JAMMING = 2
    FROZEN = 3
    JUMP = 4
    POSITION = 5
    FIELD = 7


class Prediction(NamedTuple):
    """Position that the navigator predicts at the time of a GNSS position, relative to dead reckoning."""

    position: FloatArray
    covariance: FloatArray
    alone: FloatArray
    """`position`, `covariance`, `alone`: position (2,), m north and east, and its covariance (2, 2), m²; that
    of dead reckoning alone since the last position that was used."""
    current: FloatArray
    current_sigma: float
    heading_error: float = 0.0
    travelled: float = 0.0
    speed: float = 0.0
    """`current`, `current_sigma`, `heading_error`, `travelled`, `speed`: velocity error of dead reckoning
    (2,), m/s, and its 1-sigma on each axis; 1-sigma of the velocity because of a heading known to be poor,
    m/s; distance travelled since the start, m; speed, m/s."""
    motion: MotionNoise = NO_MOTION_NOISE
    """Uncertainty of the dead-reckoned motion since the start."""
    lost: bool = False
    informed: bool = False
    """`lost`, `informed`: True if the navigator is lost; True if the field has improved its position."""


class _Position(NamedTuple):
    """Tested position: time (µs), m north and east of dead reckoning, its sigma (m), and the prediction."""

    time_us: int
    north: float
    east: float
    sigma: float
    then: Prediction


class GnssMonitor:
    """Test of GNSS positions, given in order of time.

    `state` is the use of the positions, and `reason` why they are not used. `evidence` compares the field
    with the map at the positions. `unaided` is the filter, without recent positions, that replaces the
    navigator's when the positions cease to be used; None without one.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self.state, self.reason = GnssState.NONE, GnssReason.NONE
        self.unaided: Bank | None = None
        self._grid, self._options = grid, options
        self._history: deque[_Position] = deque()
        self._place: tuple[float, float] | None = None
        self._frozen_from = 0.0  # m travelled when the receiver first sent the present position
        self._since_us = 0  # time since which the positions agree with each other
        self._count = 0  # number of positions since `_since_us`
        # False if the positions jumped from ones that were used to the present ones: no vehicle does.
        self._may_be_right = True
        self._trusted: _Position | None = None  # the first of the window when positions ceased to be used
        self._change = 0.0  # of the positions over the window against dead reckoning, in its errors
        self._reported = GnssReason.NONE
        self._reported_us = NEVER
        self.evidence = _FieldTest(grid, options)

    def rivals(self, time_us: int) -> list[Rival]:
        """Return the positions of filters without the receiver's, or the receiver's if they are not used.

        The list is empty without a recent position, or if the position cannot be right.
        """
        field, last = self.evidence, self._history[-1] if self._history else None
        if last is None or time_us - last.time_us > MAX_GNSS_AGE_US:
            return []
        if self.state is GnssState.GOOD:
            return [one.rival(PRIOR_ODDS_WRONG) for one in field.separate_filters]
        if not self._may_be_right or last.time_us - self._since_us < RIVAL_HOLD_US:
            return []
        log_odds = field.log_odds_of_position + min(field.log_odds_of_map, 0.0)
        return [Rival(np.array([last.north, last.east]), last.sigma**2 * np.eye(2), log_odds)]

    def receive_integrity(self, time_us: int, jamming: int, spoofing: int) -> None:
        """Store the receiver's own report: jamming_state and spoofing_state of GNSS_INTEGRITY."""
        self._reported_us = time_us
        if spoofing == DETECTED_STATE:
            self._reported = GnssReason.SPOOFING
        else:
            self._reported = GnssReason.JAMMING if jamming == DETECTED_STATE else GnssReason.NONE

    def new_motion(self) -> None:
        """Discard earlier positions, because a new source of motion changes the error of dead reckoning."""
        self._history.clear()
        self._trusted = None

    def new_height(self) -> None:
        """Discard the evidence of the field, because the main field that it rests on has changed."""
        self.evidence.restart()

    def fused_sigma(self, time_us: int, sigma: float) -> float:
        """Return the sigma (m) with which a position is fused, given the time since the previous one.

        Notes
        -----
        Errors of variance σ² and correlation time τ, at intervals Δt, are treated as independent errors
        of the variance σ² (1 + τ/Δt).
        """
        if len(self._history) < 2:
            return sigma
        seconds = (time_us - self._history[-2].time_us) * 1e-6
        return sigma * sqrt(1.0 + CORRELATION_TIME_S / max(seconds, 0.05))

    def check(
        self,
        time_us: int,
        place: tuple[float, float],
        offset_m: tuple[float, float],
        sigma: float,
        prediction: Prediction,
    ) -> GnssState:
        """Test a position and return the resulting state.

        `place` is latitude and longitude, deg; `offset_m` is the same position in m north and east of the
        dead-reckoned one; `sigma` is its claimed 1-sigma on each axis, m; `prediction` is the navigator's.
        """
        sigma = max(sigma, MIN_SIGMA_M)
        # A jammed receiver's claimed error varies: the smallest recent one is the limit.
        smallest = min((row.sigma for row in self._history), default=sigma)
        sigma = min(sigma, MAX_SIGMA_RATIO * smallest)
        # Every test runs on every position, because each has a history. The state then follows from the first
        # that fails: the receiver's report, a frozen position, a jump, the deviation, the field.
        jumped = self._jumps(time_us, offset_m, sigma, prediction)
        if place != self._place:
            self._place, self._frozen_from = place, prediction.travelled
        frozen = prediction.travelled - self._frozen_from > max(MIN_FROZEN_M, 4.0 * sigma)
        self.evidence.move(time_us, offset_m, sigma, restart=jumped)
        away = np.array(offset_m) - prediction.position
        P = prediction.alone if prediction.lost else prediction.covariance
        agrees = squared_mahalanobis(away, P + sigma**2 * np.eye(2)) <= MAX_DEVIATION_SIGMA**2
        if self.state is GnssState.NONE:
            self.state = GnssState.GOOD
        if self._reported and time_us - self._reported_us < MAX_GNSS_AGE_US:
            spoofed = self._reported is GnssReason.SPOOFING
            self._set(GnssState.REJECTED if spoofed else GnssState.SUSPECT, self._reported, time_us)
        elif frozen:
            self._set(GnssState.REJECTED, GnssReason.FROZEN, time_us)
        elif jumped:
            self._set(GnssState.REJECTED, GnssReason.JUMP, time_us)
        elif self.state is GnssState.GOOD:
            if not agrees:
                self._set(GnssState.REJECTED, GnssReason.POSITION, time_us)
            elif self.evidence.contradicts or (prediction.lost and self.evidence.log_odds_of_map < 0.0):
                self._set(GnssState.SUSPECT, GnssReason.FIELD, time_us)
        elif self._returns(time_us, agrees, prediction):
            self.state, self.reason, self._may_be_right = GnssState.GOOD, GnssReason.NONE, True
            self._trusted = None
        elif not agrees and prediction.informed:
            self.state = GnssState.REJECTED
        return self.state

    def observe(
        self, block: Block, step: Step, filter_likelihood: float, x: FloatArray, P: FloatArray
    ) -> None:
        """Compare a measurement of the field with the map at the last position.

        `step` is the motion since the previous measurement, `filter_likelihood` the log-likelihood of `block`
        in the navigator's filter, and x (6,), P (6, 6) the filter's estimate after it.
        """
        if self.state is GnssState.GOOD:
            self.evidence.separate(x, P)
        self.evidence.update(block, step, filter_likelihood)

    # ---- single tests --------------------------------------------------------------------------------

    def _jumps(
        self, time_us: int, offset_m: tuple[float, float], sigma: float, prediction: Prediction
    ) -> bool:
        """Return True if the position jumped: against the previous one, one WINDOW_US old, or one between.

        Notes
        -----
        In a time Δ, dead reckoning errs by the current c known at its start, times Δ. The variance of this
        error is (σ_c² + 2 σ² Δ/τ) Δ² for a Gauss-Markov current (σ, τ), plus that of a random walk.
        """
        history, o = self._history, self._options
        # Three comparisons, with the latest, a middle and the oldest position: a jump shows in the first, a
        # slow carry-off in the last.
        while len(history) > 1 and time_us - history[0].time_us > WINDOW_US:
            history.popleft()
        jumped, self._change = False, 0.0
        for then in (history[-1], history[2 * len(history) // 3], history[0]) if history else ():
            seconds = max((time_us - then.time_us) * 1e-6, 0.0)
            # the estimate of the current from before the positions were wrong
            known = then if self._trusted is None else self._trusted
            # Velocity error of dead reckoning: the current's estimate, its change since, turns and climbs.
            age = max((time_us - known.time_us) * 1e-6, 0.0)
            changed = o.current_sigma * sqrt(min(2.0 * age / o.current_time, 1.0))
            manoeuvred = sqrt(2.0 * changed_variance(o, prediction.motion.growth_since(known.then.motion)))
            velocity_error = hypot(known.then.current_sigma, changed, manoeuvred, prediction.heading_error)
            if seconds * 1e6 > OUTAGE_US:
                velocity_error = max(velocity_error, OUTAGE_SPEED_FRACTION * prediction.speed)
            # Two receiver errors, the velocity error over the time, and the random walk add in quadrature.
            error = hypot(sqrt(2.0) * sigma, velocity_error * seconds, o.drift * sqrt(seconds))
            moved = np.array(offset_m) - (then.north, then.east) - known.then.current * seconds
            distance = hypot(*moved.tolist())
            self._change = distance / error  # of the oldest position at last
            jumped |= self._change > MAX_DEVIATION_SIGMA
        if jumped:
            self._trusted = self._trusted or history[0]
            history.clear()
            self._since_us, self._count = time_us, 0
            self._may_be_right = self.state is not GnssState.GOOD
        history.append(_Position(time_us, *offset_m, sigma, prediction))
        self._count += 1
        return jumped

    # ---- changes of state ----------------------------------------------------------------------------

    def _set(self, state: GnssState, reason: GnssReason, time_us: int) -> None:
        if self.state is GnssState.GOOD:
            self._since_us, self._count = time_us, 0
            self.unaided = self.evidence.unaided(by_field=reason is GnssReason.FIELD)
            self.evidence.begin_comparison()
            self._trusted = self._trusted or self._history[0]
        self.state, self.reason = state, reason

    def _returns(self, time_us: int, agrees: bool, prediction: Prediction) -> bool:
        """Return True if positions that were suspect or rejected may be used again."""
        held_us = time_us - self._since_us
        # Positions return only after they have agreed with each other for a while.
        if held_us < HOLD_US or self._count < MIN_POSITIONS:
            return False
        # The field decides first, if the map describes it clearly better at the position.
        field, by_field = self.evidence, self.reason is GnssReason.FIELD
        on_the_map = field.log_odds_of_map > 0.0
        log_odds, limit = field.log_odds_of_position, field.limit
        if log_odds >= limit and on_the_map and (self._may_be_right or not prediction.lost):
            return True
        # Then the motion since, against dead reckoning: a spoofer's carry-off continues while rejected.
        moves = self._change > MAX_RETURN_SIGMA and held_us < MAX_HOLD_US
        if field.contradicts or log_odds <= -0.5 * limit or (moves and not by_field):
            return False
        describes = field.log_odds_of_map >= limit
        if by_field or (describes and self._may_be_right):
            return describes and (not by_field or log_odds >= 0.0)
        # Neither decides: time does. A lost navigator has no position to compare with.
        waited = held_us >= LONG_HOLD_US
        if prediction.lost:
            return waited and on_the_map
        return agrees or (waited and self._may_be_right and not prediction.informed)


class _FieldTest:
    """Test of the receiver's position by the field: two log odds, each within ± log ``options.alarm_odds``.

    `log_odds_of_map` compares the map at the position with a field unrelated to the map;
    `log_odds_of_position` compares the position with the navigator's.

    Notes
    -----
    Both are sums of log-likelihood ratios ``log p(y_k | y_1 .. y_k-1, H1) - log p(y_k | y_1 .. y_k-1, H0)``.
    Under H1 the vehicle is at the receiver's position; the position error is Gauss-Markov with the receiver's
    sigma s. Its correlation time is ``2 s^2 / q``, with q the rate (m^2/s) at which the variance of the
    positions against dead reckoning is seen to grow: a claimed error of many metres that changed within
    seconds would predict a scatter of the field that right positions do not have. Calibration bias and map
    error are free states, as in the navigator.
    Under H0 the vehicle is at the navigator's position, which has not used the receiver's. Both predict each
    measurement from all earlier ones. The first measurement does not count: it determines the bias under H1.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self.limit = log(options.alarm_odds)
        self._grid, self._options = grid, wider_level(options, grid.rms)
        self._claimed = options
        self.restart()

    def restart(self) -> None:
        """Discard all evidence and the filters without the receiver's positions."""
        self.log_odds_of_map = self.log_odds_of_position = 0.0
        self._unmapped = Unmapped(self._grid, self._options)
        self._filter: Bank | None = None
        self.separate_filters: list[Competitor] = []
        self._filtered = np.zeros(2)  # position at the last measurement
        self._positions: deque[tuple[int, float, float]] = deque(maxlen=RECENT_POSITIONS)
        self._sigma, self._time_us = inf, NEVER  # no comparison before the next position
        self._pace, self._wander, self._steps = np.zeros(2), 0.0, 0
        self._step = Step()  # since the last measurement that was used

    def unaided(self, *, by_field: bool) -> Bank | None:
        """Return the likeliest filter without recent positions; if not `by_field`, the latest; else None."""
        clean = [one for one in self.separate_filters if one.seconds >= MIN_SEPARATION_S]
        best = self.best_separate if by_field else clean[-1] if clean else None
        return None if best is None else best.filter

    @property
    def contradicts(self) -> bool:
        """True if the map contradicts the field at the positions, or a filter without them is more likely."""
        best = self.best_separate
        return self.log_odds_of_map <= -self.limit or (best is not None and best.log_odds >= self.limit)

    @property
    def best_separate(self) -> Competitor | None:
        """The likeliest of the filters without the receiver's positions; None if none is running."""
        return max(self.separate_filters, key=lambda one: one.log_odds, default=None)

    def move(self, time_us: int, offset_m: tuple[float, float], sigma: float, *, restart: bool) -> None:
        """Move the test to a position (m north and east of dead reckoning) of 1-sigma `sigma` (m).

        Discard the evidence if `restart` is True, or after a gap in the positions.
        """
        if restart or time_us - self._time_us > MAX_GNSS_AGE_US:
            self.restart()
        elif time_us > self._time_us:
            self._watch((time_us - self._time_us) * 1e-6, np.array(offset_m) - self._positions[-1][1:])
        self._positions.append((time_us, *offset_m))
        self._sigma, self._time_us = sigma, time_us

    def _watch(self, seconds: float, step: FloatArray) -> None:
        """Update mean rate (m/s) and growth of variance (m^2/s) of the positions against dead reckoning."""
        self._steps += 1
        share = max(1.0 / self._steps, min(seconds / CORRELATION_TIME_S, 1.0))
        scatter = step - self._pace * seconds
        self._wander += share * (float(scatter @ scatter) / (2.0 * seconds) - self._wander)
        self._pace = self._pace + share * (step / seconds - self._pace)

    def begin_comparison(self) -> None:
        """Discard evidence except that against the map: from now on the navigator rejects the positions."""
        self.log_odds_of_map = min(self.log_odds_of_map, 0.0)
        self.log_odds_of_position = 0.0
        self.separate_filters = []

    def separate(self, x: FloatArray, P: FloatArray) -> None:
        """Start a filter without the positions from the navigator's x (6,), P (6, 6), if one is due.

        Notes
        -----
        Solution separation: the likelihood ratio of this filter against the navigator begins at 1. As long as
        the positions are right, it exceeds c with a probability of at most 1/c in each period (Ville 1939).
        """
        if not self.separate_filters or self.separate_filters[-1].seconds >= SEPARATION_INTERVAL_S:
            self.separate_filters.append(Competitor(Bank(self._grid, x, P, inf, self._options.gate)))
        if self.separate_filters[0].seconds > SEPARATION_TIME_S:
            self.separate_filters.pop(0)

    def update(self, block: Block, step: Step, filter_likelihood: float) -> None:
        """Add a measurement to the log odds; `step` is the motion since the previous measurement."""
        self._step = self._step.joined(step)
        if abs(block.time_us - self._time_us) > MAX_GNSS_AGE_US:
            return
        whole, self._step = self._step, Step()
        F, Q = transition(self._claimed, *whole)
        for one in self.separate_filters:
            one.seconds += whole.seconds
            one.filter.predict(F, Q)
            one.update(block, filter_likelihood)
        is_first = self._filter is None
        if self._filter is None:
            x, P = prior(self._options, self._sigma)
            P[2:4, 2:4] = 0.0  # the receiver's positions move the filter, not dead reckoning
            self._filter = Bank(self._grid, x, P, inf, self._options.gate)
        self._predict(self._filter, whole, block.time_us)
        seen = self._filter.update(block)
        unmapped = self._unmapped.update(block, whole, self._filter.curvature_variance)
        if is_first or not seen.variance > 0.0:  # off the map
            return
        if not seen.accepted:  # as the filter does: a rejected measurement is never evidence for the map
            unmapped = max(unmapped, seen.log_likelihood)
        # Cumulative sums of log-likelihood ratios, limited so that a change of truth shows soon.
        sums = self.log_odds_of_map - unmapped, self.log_odds_of_position - filter_likelihood
        limited = np.clip(np.add(sums, seen.log_likelihood), -self.limit, self.limit)
        self.log_odds_of_map, self.log_odds_of_position = limited.tolist()

    def _predict(self, bank: Bank, step: Step, time_us: int) -> None:
        """Propagate the filter of H1 to `time_us`: the receiver's error decays, and its position moves."""
        # Interpolate the position: with a wrong heading, dead reckoning departs from it by metres per second.
        times, north, east = np.array(self._positions).T
        position = np.array([np.interp(time_us, times, north), np.interp(time_us, times, east)])
        F, Q = transition(self._options, *step)
        F[:4], Q[:4] = 0.0, 0.0
        # correlation time 2 s^2 / q, and not below the shortest
        wander = max(self._wander, 2.0 * MIN_SIGMA_M**2 / JITTER_TIME_S)
        kept = exp(-step.seconds * min(0.5 * wander / self._sigma**2, 1.0 / JITTER_TIME_S))
        F[0, 0] = F[1, 1] = kept
        Q[0, 0] = Q[1, 1] = self._sigma**2 * (1.0 - kept * kept)
        bank.x[:2] -= self._filtered[:, None]
        bank.predict(F, Q)
        bank.x[:2] += position[:, None]
        self._filtered = position
