"""Integrity of GNSS positions: each is tested before the navigator uses it.

A receiver that is jammed or spoofed goes on to report a 3-D fix with a small error. Its positions are tested
against what else is known:

=========== ============================================================================================
jump        two positions differ by more than dead reckoning and its errors allow between them
frozen      the position stays the same while the vehicle moves
position    it differs from the navigator's position by more than both claim
field       the map does not describe the measured field at the position
spoofing,   the receiver reports it (GNSS_INTEGRITY)
jamming
=========== ============================================================================================

All positions are relative to the dead-reckoned position, so that a difference of two positions is the error
of dead reckoning between them, whatever the vehicle did.
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
from magbridge.navigate.deadreckoning import Step
from magbridge.navigate.integrity import Unmapped, squared_mahalanobis
from magbridge.navigate.model import Block, prior, transition
from magbridge.navigate.options import NavigationOptions, any_level

__all__ = ["GnssMonitor", "GnssReason", "GnssState", "Prediction"]

MAX_DEVIATION_SIGMA = 4.5
"""Deviation from a prediction, in sigmas, beyond which a position is rejected; by chance 4e-5 of right ones
are, two degrees of freedom."""
MIN_SIGMA_M = 1.5
"""Smallest sigma of a receiver that is used, m: its error changes slowly."""
MAX_RETURN_SIGMA, MAX_HOLD_US = 2.0, 180_000_000
"""Largest change of the positions against dead reckoning, in sigmas of dead reckoning, with which rejected
positions are used again; and the µs for which this limit holds, because a change of the wind lasts. By chance
14 % of the changes are larger, two degrees of freedom."""
WINDOW_US = 30_000_000
"""µs over which the motion by GNSS is compared with dead reckoning."""
MEAN_TIME_S = 20.0
"""Time constant of the mean deviation from the navigator, s."""
HOLD_US, LONG_HOLD_US = 20_000_000, 45_000_000
"""µs for which positions must agree with each other until they are used again: if the navigator or the field
agrees, and if neither can tell."""
MAX_SIGMA_RATIO = 3.0
"""Largest sigma of a position over the smallest in WINDOW_US: a jammed receiver claims now 2 m, now 200 m."""
MIN_POSITIONS = 3
"""Number of positions in that time."""
OUTAGE_US = 60_000_000
"""µs without a position, after which dead reckoning may be off by more than ``current_sigma`` says."""
OUTAGE_SPEED_FRACTION = 0.1
"""1-sigma of the velocity error after an outage, as a fraction of the speed."""
MIN_FROZEN_M = 10.0
"""Distance that the vehicle must have moved until a constant position is frozen, m."""
UNSEEN_FRACTION = 0.1
"""Error of positions, in correlation lengths of the map, that the field shows only after it has lasted."""
MAX_GNSS_AGE_US = 10_000_000
"""µs for which a position, or a report of the receiver's, holds."""
CORRELATION_TIME_S = 30.0
"""s over which the errors of successive positions are correlated."""
SEPARATION_TIME_S = 120.0
"""s for which a filter goes on without the positions that the navigator uses; then it starts again."""
RECENT_POSITIONS = 64
"""Number of positions between which that of a measurement is interpolated."""
OK_STATE, DETECTED_STATE = 1, 3
"""GPS_JAMMING_STATE and GPS_SPOOFING_STATE: nothing found; found and not mitigated."""


class GnssState(IntEnum):
    """Use of the receiver's positions; the values are those sent over the link."""

    NONE = 0
    """No position yet."""
    GOOD = 1
    """They are used."""
    SUSPECT = 2
    """They are not used, but could be right."""
    REJECTED = 3
    """They are wrong."""


class GnssReason(IntEnum):
    """Why positions are not used; the values are those sent over the link."""

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
    """(2,), m, north and east."""
    covariance: FloatArray
    alone: FloatArray
    """`covariance`, `alone`, (2, 2), m²: of the position, and of dead reckoning since the last position that
    was used."""
    current: FloatArray
    """(2,), m/s, by which dead reckoning is wrong."""
    current_sigma: float
    travelled: float
    speed: float
    """`current_sigma`, `travelled`, `speed`: m/s on each axis, m since the start, m/s."""
    turns: float
    """:attr:`MotionNoise.turns` since the start."""
    lost: bool
    informed: bool
    """`lost`, `informed`: The navigator is lost; the field has improved its position."""


class _Position(NamedTuple):
    """A position that was tested: µs; m relative to dead reckoning; m; the current known then, m/s; turns."""

    time_us: int
    north: float
    east: float
    sigma: float
    current_north: float
    current_east: float
    current_sigma: float
    turns: float


class GnssMonitor:
    """Test GNSS positions, in order of time; `state` and, where they are not used, the `reason`.

    `drift` (m) is the mean distance of the positions that were used from the navigator's, over 20 s, and
    `evidence` compares the field with the map at its position.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self.state, self.reason = GnssState.NONE, GnssReason.NONE
        self.drift = 0.0
        self._grid, self._options = grid, options
        self._history: deque[_Position] = deque()
        self._place: tuple[float, float] | None = None
        self._frozen_from = 0.0  # m travelled when the position was first the present one
        self._since_us = 0  # since when the positions agree with each other
        self._count = 0  # positions since then
        self._chained = True  # no jump since the last position that was used
        self._trusted: _Position | None = None  # the first of the window when positions ceased to be used
        self._change = 0.0  # of the positions over the window against dead reckoning, in its errors
        self._mean = np.zeros(2)
        self._reported = GnssReason.NONE
        self._reported_us = -MAX_GNSS_AGE_US
        self.evidence = _FieldTest(grid, options)

    @property
    def possible_error(self) -> float:
        """Error that positions may have had while they were still used, m."""
        unseen = UNSEEN_FRACTION * self._grid.correlation_length if self.reason is GnssReason.FIELD else 0.0
        return hypot(self.drift, unseen)

    def receive_integrity(self, time_us: int, jamming: int, spoofing: int) -> None:
        """Use the receiver's own report, GNSS_INTEGRITY's jamming_state and spoofing_state."""
        self._reported_us = time_us
        if spoofing == DETECTED_STATE:
            self._reported = GnssReason.SPOOFING
        else:
            self._reported = GnssReason.JAMMING if jamming == DETECTED_STATE else GnssReason.NONE

    def new_motion(self) -> None:
        """Forget earlier positions: the error of dead reckoning is another from now on."""
        self._history.clear()
        self._trusted = None

    def fused_sigma(self, time_us: int, sigma: float) -> float:
        """Return the sigma (m) with which a position is fused, given the time since the previous one.

        Notes
        -----
        Errors of one variance σ² that are correlated over τ, each Δt, count as independent ones
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
        """Test a position and return the state.

        `place`: latitude and longitude, deg. `offset_m`: the same, m north and east of the dead-reckoned
        position. `sigma`: m, on each axis. `prediction`: of the navigator, at this time.
        """
        sigma = max(sigma, MIN_SIGMA_M)
        # A jammed receiver's claimed error varies: the smallest recent one is the limit.
        smallest = min((row.sigma for row in self._history), default=sigma)
        sigma = min(sigma, MAX_SIGMA_RATIO * smallest)
        # Every test runs on every position, because each has a history. The state then follows from the first
        # that fails: the receiver's report, a frozen position, a jump, the deviation, the field.
        jumped = self._jumps(time_us, offset_m, sigma, prediction)
        frozen = self._frozen(place, sigma, prediction.travelled)
        self.evidence.move(time_us, offset_m, sigma, restart=jumped)
        away = np.array(offset_m) - prediction.position
        agrees = self._agrees(away, sigma, prediction)
        if self.state is GnssState.NONE:
            self.state = GnssState.GOOD
        if reported := self._receiver_reports(time_us):
            spoofed = reported is GnssReason.SPOOFING
            self._set(GnssState.REJECTED if spoofed else GnssState.SUSPECT, reported, time_us)
        elif frozen:
            self._set(GnssState.REJECTED, GnssReason.FROZEN, time_us)
        elif jumped:
            self._set(GnssState.REJECTED, GnssReason.JUMP, time_us)
        elif self.state is GnssState.GOOD:
            self._leave_good(time_us, agrees=agrees, lost=prediction.lost)
        elif self._returns(time_us, agrees, prediction):
            self.state, self.reason, self._chained = GnssState.GOOD, GnssReason.NONE, True
            self._trusted = None
        elif not agrees and prediction.informed:
            self.state = GnssState.REJECTED
        if self.state is GnssState.GOOD:
            self._average(time_us, away)
        return self.state

    def observe(
        self, block: Block, step: Step, filter_likelihood: float, x: FloatArray, P: FloatArray
    ) -> None:
        """Compare a measurement of the field with the map at the last position.

        It is one `step` after the previous one, with a log-likelihood by the navigator's filter, whose
        estimate is now x (6,), P (6, 6).
        """
        if self.state is GnssState.GOOD:
            self.evidence.separate(x, P)
        self.evidence.update(block, step, filter_likelihood)

    # ---- single tests --------------------------------------------------------------------------------

    def _jumps(
        self, time_us: int, offset_m: tuple[float, float], sigma: float, prediction: Prediction
    ) -> bool:
        """Compare with the previous position, that of WINDOW_US ago, and one between them.

        Notes
        -----
        In a time Δ, dead reckoning errs by the current c that was known at its start, with the variance
        (σ_c² + 2 σ² Δ/τ) Δ² of a Gauss-Markov current (σ, τ), and by its own random walk.
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
            # Velocity error of dead reckoning: the current's estimate, its change since, and turns.
            age = max((time_us - known.time_us) * 1e-6, 0.0)
            changed = o.current_sigma * sqrt(min(2.0 * age / o.current_time, 1.0))
            turned = o.motion_error * sqrt(prediction.turns - known.turns)
            velocity_error = hypot(known.current_sigma, changed, turned)
            if seconds * 1e6 > OUTAGE_US:
                velocity_error = max(velocity_error, OUTAGE_SPEED_FRACTION * prediction.speed)
            # Two receiver errors, the velocity error over the time, and the random walk add in quadrature.
            error = hypot(sqrt(2.0) * sigma, velocity_error * seconds, o.drift * sqrt(seconds))
            distance = hypot(
                offset_m[0] - then.north - known.current_north * seconds,
                offset_m[1] - then.east - known.current_east * seconds,
            )
            self._change = distance / error  # of the oldest position at last
            jumped |= self._change > MAX_DEVIATION_SIGMA
        if jumped:
            self._trusted = self._trusted or history[0]
            history.clear()
            self._since_us, self._count, self._chained = time_us, 0, False
        north, east = prediction.current.tolist()
        history.append(
            _Position(time_us, *offset_m, sigma, north, east, prediction.current_sigma, prediction.turns)
        )
        self._count += 1
        return jumped

    def _frozen(self, place: tuple[float, float], sigma: float, travelled: float) -> bool:
        if place != self._place:
            self._place, self._frozen_from = place, travelled
        return travelled - self._frozen_from > max(MIN_FROZEN_M, 4.0 * sigma)

    def _agrees(self, away: FloatArray, sigma: float, prediction: Prediction) -> bool:
        """Return True if a deviation (2,) from the navigator is within both errors."""
        P = prediction.alone if prediction.lost else prediction.covariance
        return squared_mahalanobis(away, P + sigma**2 * np.eye(2)) <= MAX_DEVIATION_SIGMA**2

    def _average(self, time_us: int, away: FloatArray) -> None:
        """Add the deviation (2,), m, of a position that is used to the mean."""
        seconds = (time_us - self._history[-2].time_us) * 1e-6 if len(self._history) > 1 else inf
        # Exponential mean with the time constant MEAN_TIME_S; it starts again after a pause.
        kept = exp(-seconds / MEAN_TIME_S) if seconds < MEAN_TIME_S else 0.0
        self._mean = kept * self._mean + (1.0 - kept) * away
        self.drift = hypot(*self._mean.tolist())

    def _receiver_reports(self, time_us: int) -> GnssReason:
        return self._reported if time_us - self._reported_us < MAX_GNSS_AGE_US else GnssReason.NONE

    # ---- changes of state ----------------------------------------------------------------------------

    def _leave_good(self, time_us: int, *, agrees: bool, lost: bool) -> None:
        if not agrees:
            self._set(GnssState.REJECTED, GnssReason.POSITION, time_us)
        elif self.evidence.contradicts or (lost and self.evidence.log_odds_of_map < 0.0):
            self._set(GnssState.SUSPECT, GnssReason.FIELD, time_us)

    def _set(self, state: GnssState, reason: GnssReason, time_us: int) -> None:
        if self.state is GnssState.GOOD:
            self._since_us, self._count = time_us, 0
            self.evidence.begin_comparison()
            self._trusted = self._trusted or self._history[0]
        self.state, self.reason = state, reason

    def _returns(self, time_us: int, agrees: bool, prediction: Prediction) -> bool:
        """Return True if positions that were not used are right again."""
        held_us = time_us - self._since_us
        # Positions return only after they have agreed with each other for a while.
        if held_us < HOLD_US or self._count < MIN_POSITIONS:
            return False
        # The field decides first: it describes the position better than the navigator's, or worse.
        field, by_field = self.evidence, self.reason is GnssReason.FIELD
        if field.favours and field.log_odds_of_map > 0.0:
            return True
        # Then the motion since, against dead reckoning; a carry-off goes on while it is held back.
        moves = self._change > MAX_RETURN_SIGMA and held_us < MAX_HOLD_US
        if field.contradicts or field.disfavours or (moves and not by_field):
            return False
        if field.confirms or by_field:
            return field.confirms
        # Neither decides: time does. A lost navigator has no position to compare with.
        waited = held_us >= LONG_HOLD_US
        if prediction.lost:
            return waited and field.log_odds_of_map > 0.0
        return agrees or (waited and self._chained and not prediction.informed)


class _FieldTest:
    """Log odds of the receiver's position by the field, each within ± `limit` (``options.alarm_odds``).

    `log_odds_of_map` is against a field unrelated to the map, `log_odds_of_position` against the navigator.

    Notes
    -----
    Both are sums of log-likelihood ratios ``log p(y_k | y_1 .. y_k-1, H1) - log p(y_k | y_1 .. y_k-1, H0)``.
    Under H1 the vehicle is at the receiver's position; the position error is Gauss-Markov with the receiver's
    sigma and :data:`CORRELATION_TIME_S`, so that the field's information on it lasts that long. Calibration
    bias and map error are free states, as in the navigator. Under H0 the vehicle is where the navigator is,
    which has not used the positions. Both predict each measurement from all earlier ones. The first is not
    counted: it determines the level under H1.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self.limit = log(options.alarm_odds)
        self._grid, self._options = grid, any_level(options, grid)
        self._claimed = options
        self._time_us = -MAX_GNSS_AGE_US
        self._restart()

    def _restart(self) -> None:
        self.log_odds_of_map = self.log_odds_of_position = 0.0
        self._against = 0.0  # cumulative sum of the odds against the map, never negative (Page 1954)
        self._unmapped = Unmapped(self._grid, self._options)
        self._filter: Bank | None = None
        self._separate: Bank | None = None
        self._separated_s = self._log_odds_separate = 0.0
        self._filtered = np.zeros(2)  # position at the last measurement
        self._positions: deque[tuple[int, float, float]] = deque(maxlen=RECENT_POSITIONS)
        self._sigma = inf
        self._step = Step()  # since the last measurement that was used

    @property
    def contradicts(self) -> bool:
        """Return True if the map does not describe the field there, or describes it better without it."""
        return self._against >= self.limit or self._log_odds_separate >= self.limit

    @property
    def confirms(self) -> bool:
        """Return True if the map describes the field at the position, not worse than at the navigator's."""
        return self.log_odds_of_map >= self.limit and self.log_odds_of_position >= 0.0

    @property
    def disfavours(self) -> bool:
        """Return True if the map describes the field better at the navigator's position, with odds of 45."""
        return self.log_odds_of_position <= -0.5 * self.limit

    @property
    def favours(self) -> bool:
        """Return True if the map describes the field at the position better than at the navigator's."""
        return self.log_odds_of_position >= self.limit

    def move(self, time_us: int, offset_m: tuple[float, float], sigma: float, *, restart: bool) -> None:
        """Continue at a position (m, north and east of dead reckoning) with its 1-sigma (m)."""
        if restart or time_us - self._time_us > MAX_GNSS_AGE_US:
            self._restart()
        self._positions.append((time_us, *offset_m))
        self._sigma, self._time_us = sigma, time_us

    def begin_comparison(self) -> None:
        """Discard the evidence so far: from now on the navigator does not use the positions."""
        self.log_odds_of_map = min(self.log_odds_of_map, 0.0)
        self.log_odds_of_position = self._log_odds_separate = 0.0
        self._separate = None

    def separate(self, x: FloatArray, P: FloatArray) -> None:
        """Start a filter without the positions, from the navigator's estimate x (6,), P (6, 6), if it is due.

        Notes
        -----
        Solution separation: its log-likelihood ratio against the navigator begins at 0. As long as the
        positions are right, it exceeds c with a probability of at most 1/c in each period (Ville 1939).
        """
        if self._separate is None or self._separated_s > SEPARATION_TIME_S:
            self._separate = Bank(self._grid, x, P, inf, self._options.gate)
            self._separated_s = self._log_odds_separate = 0.0

    def _compare_separate(self, block: Block, step: Step, filter_likelihood: float) -> None:
        """Add a measurement to the odds of the filter without positions against the navigator with them."""
        if self._separate is not None:
            self._separated_s += step.seconds
            self._separate.predict(*transition(self._claimed, *step))
            self._log_odds_separate += self._separate.update(block).log_likelihood - filter_likelihood

    def update(self, block: Block, step: Step, filter_likelihood: float) -> None:
        """Add a measurement, one `step` after the previous one."""
        self._step = self._step.joined(step)
        if abs(block.time_us - self._time_us) > MAX_GNSS_AGE_US:
            return
        whole, self._step = self._step, Step()
        self._compare_separate(block, whole, filter_likelihood)
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
        self._against = min(max(self._against - seen.log_likelihood + unmapped, 0.0), self.limit)
        self.log_odds_of_map = self._limited(self.log_odds_of_map + seen.log_likelihood - unmapped)
        gained = seen.log_likelihood - filter_likelihood
        self.log_odds_of_position = self._limited(self.log_odds_of_position + gained)

    def _predict(self, bank: Bank, step: Step, time_us: int) -> None:
        """Propagate the filter of H1 to a time: the receiver's error decays, and its position moves."""
        # Interpolated: with a wrong heading dead reckoning leaves the receiver by metres in a second.
        times, north, east = np.array(self._positions).T
        position = np.array([np.interp(time_us, times, north), np.interp(time_us, times, east)])
        F, Q = transition(self._options, *step)
        F[:4], Q[:4] = 0.0, 0.0
        kept = exp(-step.seconds / CORRELATION_TIME_S)
        F[0, 0] = F[1, 1] = kept
        Q[0, 0] = Q[1, 1] = self._sigma**2 * (1.0 - kept * kept)
        bank.x[:2] -= self._filtered[:, None]
        bank.predict(F, Q)
        bank.x[:2] += position[:, None]
        self._filtered = position

    def _limited(self, log_odds: float) -> float:
        return min(max(log_odds, -self.limit), self.limit)
