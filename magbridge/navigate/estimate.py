"""Estimate of the position by one filter or a bank of them, and the tests of its validity."""

from __future__ import annotations

from math import exp, expm1, inf, isfinite, log, sqrt

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import Bank, Innovation, widest
from magbridge.navigate.deadreckoning import MotionNoise, Step
from magbridge.navigate.integrity import (
    ELSEWHERE,
    Competitor,
    IntegrityMonitor,
    Unmapped,
    Verdict,
    squared_mahalanobis,
)  # fmt: skip
from magbridge.navigate.model import NO_MOTION_NOISE, Block, prior, resolution, transition
from magbridge.navigate.options import NavigationOptions, wider_level
from magbridge.navigate.record import Jump, NavigationState, Rival

__all__ = ["Estimate"]

MAX_FIX_DISTANCE_SQUARED = 25.0
"""Largest squared Mahalanobis distance of a fix from the estimate; 4e-6 of right fixes exceed it."""
MAX_INFORMED_RATIO = 0.8
"""Largest position sigma with which the field counts as informative, over that of dead reckoning alone."""
MIN_SEARCH_RADIUS_M = 300.0
"""Smallest 1-sigma with which the integrity monitor searches around the filter, m."""
JOIN_SPREAD, SPLIT_SPREAD = 1.2, 1.5
"""Position spreads, in resolutions, below which a bank becomes one filter and above which a filter splits."""
MIN_REFINEMENT = 0.8
"""Fraction of the resolution; a measurement changes the resolution only if it needs less than this."""
SUSPECT_LOG_ODDS = 1.0
"""Natural log odds of another place above which the position is invalid, even below ``alarm_odds``."""
RESTLESS_FRACTION, PRIOR_ODDS_RESTLESS = 0.1, 0.3
"""Growth of the velocity error of restless motion, as with a wrong heading, over the speed in one correlation
length of the map; odds of such motion before the field is compared."""
MIN_LOG_ODDS_RESTLESS = -3.0
"""Natural log-likelihood ratio below which the filter of restless motion begins again."""
SEARCH_SPREADS = (2.0, 4.0, 2.0, 8.0)
"""1-sigma of successive searches, in units of :meth:`Estimate._reach`."""


class Estimate:
    """Estimate of the position relative to a dead-reckoned track, from blocks and fixes in order of time.

    `x` (6,) and `P` (6, 6) are mean and covariance of the states of :mod:`~magbridge.navigate.model`. They
    hold at `time_us` (µs), the time of the last start, fix or measurement. `travelled` (m) and `motion` are
    distance and uncertainty of the dead-reckoned motion from the start to `time_us`; `step` is the motion
    between the last two measurements on the map.

    `valid` is True if the map has described the field at odds of ``options.alarm_odds``, no other place
    remains possible, and no test rejects the position. For a smoother, `moved` holds F and Q of the last
    prediction, and `jumps` the restarts, which it must not cross. `alone_x` (4,) and `alone` (4, 4) are mean
    and covariance of position and current by dead reckoning alone since the start or the last fix. `options`
    are the given ones, but with a wider bias once the filter was lost. `rivals` are other positions of the
    vehicle, by the test of the GNSS positions.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions) -> None:
        self.grid, self.options, self._claimed = grid, options, options
        self.state = NavigationState.OFF
        self.x, self.P = prior(options)
        self.valid = False
        self.rivals: list[Rival] = []
        self._restless: Competitor | None = None  # a filter whose velocity error grows faster
        self.moved = np.eye(6), np.zeros((6, 6))
        self.jumps: list[Jump] = []
        self.time_us, self.travelled, self.motion = 0, 0.0, NO_MOTION_NOISE
        self.step = Step()
        self._measured = 0, 0.0, NO_MOTION_NOISE  # µs, m, noise of the motion at the last measurement
        self._filter: Bank | None = None
        self._monitor: IntegrityMonitor | None = None
        self._unmapped = Unmapped(grid, options)
        self._log_odds_unmapped = 0.0
        self._resolution = inf
        self.alone_x, self.alone = self.x[:4].copy(), self.P[:4, :4].copy()
        self._level: tuple[float, int] | None = (
            None  # variance of the bias at a known place, nT²; its time, µs
        )
        self._lost = self._known = False  # lost; valid at least once
        self._searches = 0
        self._unique = False  # competing filters that began wider have come to the same place
        self._map_confirmed = False  # the map has described the field
        self._fixed = False  # the place is that of a fix

    @property
    def position_covariance(self) -> FloatArray:
        """Covariance (2, 2) of the position, m²; it includes the rivals' positions by their odds."""
        # Mixture of N(x, P) with the odds 1 and each N(y, S) with the odds o, about x, with d = y - x:
        # (P + sum of o (S + d d')) / (1 + sum of o).
        total, odds = self.P[:2, :2], 1.0
        for y, S, log_odds in self._all_rivals():
            d, ratio = y - self.x[:2], exp(log_odds)
            total, odds = total + ratio * (S + np.outer(d, d)), odds + ratio
        return np.asarray(total / odds)

    def _all_rivals(self) -> list[Rival]:
        return self.rivals + ([self._restless.rival(PRIOR_ODDS_RESTLESS)] if self._restless else [])

    @property
    def begun(self) -> bool:
        """True if the filter has used a measurement."""
        return self._filter is not None

    @property
    def odds(self) -> float:
        """Natural logarithm of the odds of another place against the filter's."""
        return self._monitor.odds if self._monitor else 0.0

    @property
    def hypotheses(self) -> int:
        """Number of hypotheses of the filter; 1 before the first measurement."""
        return len(self._filter) if self._filter else 1

    def start(self, time_us: int, sigma: float) -> None:
        """Start at the dead-reckoned position, whose 1-sigma on each axis is `sigma`, m."""
        self.time_us = time_us
        self._measured = time_us, self.travelled, self.motion
        self.x, self.P = prior(self.options, sigma)
        self.alone_x, self.alone = self.x[:4].copy(), self.P[:4, :4].copy()
        self._unique = sigma >= self._reach()
        self.state = NavigationState.SEARCHING

    def correct(self, fix: FloatArray, sigma: float, fused_sigma: float | None = None) -> None:
        """Update with a fix at the time of the last prediction; restart there if it contradicts the filter.

        `fix` (2,) is in m north and east of the dead-reckoned position, and `sigma` (m) its 1-sigma on each
        axis. The filter fuses it with `fused_sigma` (m), which allows for correlation with the previous fix.
        A fix does not end :attr:`NavigationState.LOST`: the map must first describe the field there.
        """
        assert self._filter is not None
        self._refresh()
        # Chi-square test of the fix with two degrees of freedom. A fix that fails replaces the position;
        # current, bias and map error keep their estimates, with their prior variance added.
        distance = squared_mahalanobis(fix - self.x[:2], self.P[:2, :2] + sigma**2 * np.eye(2))
        if distance > MAX_FIX_DISTANCE_SQUARED:
            _, start = prior(self.options, sigma)
            start[2:, 2:] += self.P[2:, 2:]
            there = np.concatenate([fix, self.x[2:]])
            self._jump(there, "a fix contradicts the filter")
            self._filter, self.x, self.P = self._estimator(there, start), there, start
            self._log_odds_unmapped = 0.0
        else:
            self._filter.update_position(float(fix[0]), float(fix[1]), fused_sigma or sigma)
            self._refresh()
        # The filter was lost: the map has to describe the field again at the fix.
        if self._lost and not self._fixed:
            self._map_confirmed, self._log_odds_unmapped = False, 0.0
        self._monitor, self._unique, self._fixed = None, True, True
        self._restless = None
        self.alone_x = self.x[:4].copy()
        self.alone = np.diag([sigma**2, sigma**2, *np.diag(self.P)[2:4]])

    def replace(self, bank: Bank, cause: str) -> None:
        """Replace the filter by one with other fixes or another motion, which is likelier."""
        x, P = bank.moments()
        unique = self._unique
        self._jump(x, cause)
        self._filter, self._unique = bank, unique
        self._refresh()
        if widest(self.alone) < widest(P):  # dead reckoning went on from wrong fixes
            self.alone_x, self.alone = x[:4].copy(), P[:4, :4].copy()

    def update(self, block: Block, travelled: float, motion: MotionNoise = NO_MOTION_NOISE) -> Innovation:
        """Update with a measurement and return its innovation, NaN off the map.

        `travelled` (m) and `motion` are distance and uncertainty of the motion since the start.
        """
        self.predict(block.time_us, travelled, motion)
        # 1. The resolution follows the most precise measurement so far.
        finer = resolution(self.grid, self.options, block.variance)
        if finer < MIN_REFINEMENT * self._resolution:  # never coarser: a first block may have been a poor one
            self._resolution = finer
            if self._filter and not self._filter.is_single:
                self._filter.finest = finer
        if self._filter is None:
            self._filter = self._estimator(self.x, self.P)
        # 2. Kalman update of the one filter, or of each hypothesis.
        seen = self._filter.update(block)
        self._refresh()
        # 3. On the map: compare the filter with other explanations of the same measurement.
        on_the_map = isfinite(seen.anomaly)
        if on_the_map:
            if self._restless:
                self._restless.update(block, seen.log_likelihood)
            if widest(self.alone) < self._resolution:
                self._level = float(self.P[4, 4]), block.time_us
            then_us, before, earlier = self._measured
            seconds = max((block.time_us - then_us) * 1e-6, 0.0)
            self.step = Step(seconds, travelled - before, motion.growth_since(earlier))
            self._measured = block.time_us, travelled, motion
            self._judge(block, seen)
            # A filter of restless motion begins again if it is unlikely, so that such motion shows soon.
            if self._restless is None or self._restless.log_odds < MIN_LOG_ODDS_RESTLESS:
                bank = Bank(self.grid, self.x, self.P, self._resolution, self.options.gate)
                self._restless = Competitor(bank)
            elif self._restless.log_odds > log(self.options.alarm_odds):
                self.replace(self._restless.filter, "a filter with restless motion is likelier")
        # 4. One filter or a bank, the state, and whether the position may be used.
        self._set_state(on_the_map)
        proven = self._unique and self._map_confirmed
        suspect = self.odds > SUSPECT_LOG_ODDS or self._log_odds_unmapped > 0.0 or self._is_vague
        self.valid = self.state is NavigationState.TRACKING and proven and not suspect
        self._known |= self.valid
        return seen

    def predict(self, time_us: int, travelled: float, motion: MotionNoise = NO_MOTION_NOISE) -> None:
        """Propagate the states to `time_us`, where the vehicle has travelled `travelled` m since the start.

        If `time_us` precedes the last update, the states keep the later time. This happens if a fix came
        between the samples of a block: a covariance can only be propagated forward.
        """
        time_us = max(time_us, self.time_us)
        seconds, metres = (time_us - self.time_us) * 1e-6, travelled - self.travelled
        # x' = F x, P' = F P F' + Q. Dead reckoning alone follows the same model without measurements.
        F, Q = transition(self.options, seconds, metres, motion.growth_since(self.motion))
        if self._restless and seconds > 0.0:
            # Random walk of the velocity error: (f v)^2 for each correlation length of the map.
            gained = (RESTLESS_FRACTION * metres / seconds) ** 2 * metres / self.grid.correlation_length
            self._restless.filter.predict(F, Q + np.diag([0.0, 0.0, gained, gained, 0.0, 0.0]))
        self.time_us, self.travelled, self.motion = time_us, travelled, motion
        self.alone_x = F[:4, :4] @ self.alone_x
        self.alone = F[:4, :4] @ self.alone @ F[:4, :4].T + Q[:4, :4]
        self.moved = F, Q
        if self._filter is None:
            self.x, self.P = F @ self.x, F @ self.P @ F.T + Q
        else:
            self._filter.predict(F, Q)

    def widen_current(self, sigma: float) -> None:
        """Widen the current of every filter to a 1-sigma of at least `sigma`, m/s, on each axis."""
        for bank in self._banks():
            Q = np.zeros_like(self.P)
            Q[2:4, 2:4] = missing_variance(bank.moments()[1][2:4, 2:4], sigma)
            bank.predict(np.eye(len(Q)), Q)
        if self._filter is not None:
            self.alone[2:, 2:] += missing_variance(self.alone[2:, 2:], sigma)
        self._restless = None
        self._refresh()

    def widen_bias(self, sigma: float) -> None:
        """Add the variance `sigma`², nT², to the bias of every filter."""
        for bank in self._banks():
            bank.predict(np.eye(len(self.P)), np.diag([0.0, 0.0, 0.0, 0.0, sigma * sigma, 0.0]))
        self._restless = None
        self._refresh()

    def _banks(self) -> list[Bank]:
        """Return the filter and the monitor's filters; none before the start."""
        others = [self._monitor.here, self._monitor.elsewhere] if self._monitor else []
        return [] if self._filter is None else [self._filter, *others]

    def _refresh(self) -> None:
        if self._filter is not None:
            self.x, self.P = self._filter.moments()

    # ---- one hypothesis or many, and the tests of the estimate -------------------------------------------

    def _estimator(self, x: FloatArray, P: FloatArray) -> Bank:
        """Return one filter if the position's covariance is narrow enough for the map, else a bank."""
        single = widest(P) < SPLIT_SPREAD * self._resolution
        return Bank(self.grid, x, P, inf if single else self._resolution, self.options.gate)

    def _jump(self, x: FloatArray, cause: str) -> None:
        north, east = (x[:2] - self.x[:2]).tolist()
        self.jumps.append(Jump(self.time_us, north, east, widest(self.alone), cause))
        self._monitor, self._unique, self._fixed = None, False, False
        self._restless = None

    def _judge(self, block: Block, seen: Innovation) -> None:
        """Compare the filter with the competing explanations, and replace it if one of them has won."""
        assert self._filter is not None
        # Log odds of 'the map is unrelated to the field' against the filter, as a cumulative sum that starts
        # again at its lower limit (Page 1954).
        unmapped = self._unmapped.update(block, self.step, self._filter.curvature_variance)
        against = unmapped - seen.log_likelihood
        # The likelihood is limited by the gate: a rejected sample never supports the map.
        if not seen.accepted:
            against = max(against, 0.0)
        self._log_odds_unmapped = max(self._log_odds_unmapped + against, -log(self.options.alarm_odds))
        if self._log_odds_unmapped > log(self.options.alarm_odds):
            self._restart_search()
            return
        self._map_confirmed |= self._log_odds_unmapped <= -log(self.options.alarm_odds)
        if self._map_confirmed and self._fixed and self._unique:
            self._lost, self._searches = False, 0
        # As long as the filter itself is spread over several places, a comparison has no meaning.
        if not self._compact(widest(self.P)):
            return
        if self._monitor is None:
            reach = self._reach() * (2.0 if self._lost else 1.0)
            self._monitor = IntegrityMonitor(
                self.grid, self.options, self.x, self.P, block.time_us, reach, self._resolution,
                self._levels(),
            )  # fmt: skip
            return
        verdict = self._monitor.step(block, self.step, self.x, self.P)
        if verdict is Verdict.ELSEWHERE:
            self._filter, self._lost = self._monitor.surrender(block.time_us), True
            self._jump(self._filter.moments()[0], verdict.value)
            self._refresh()
        elif verdict is Verdict.HOLDS:
            self._monitor, self._unique = None, True
            if self._map_confirmed:
                self._lost, self._searches = False, 0

    def _levels(self) -> tuple[float, float]:
        """Return two 1-sigmas (nT) of the bias: of all competing hypotheses, and of half of them (0: same).

        Where the position was last known, the field determined the bias; since then the bias has drifted as
        its model allows. After a search, half of the hypotheses have the wide bias of that search.
        """
        o = self._claimed
        level = o.bias_sigma
        if self._level is not None:
            variance, then = self._level
            # A Gauss-Markov bias gains the variance s^2 (1 - exp(-2 t / tau)) in the time t.
            changed = -expm1(-2.0 * (self.time_us - then) * 1e-6 / o.bias_time)
            level = min(level, sqrt(variance + level**2 * changed))
        return level, self.options.bias_sigma if self.options is not o else 0.0

    def _restart_search(self) -> None:
        """Restart with a search around dead reckoning, by the next of SEARCH_SPREADS and an unknown bias."""
        self._log_odds_unmapped, self._map_confirmed, self._lost = 0.0, False, True
        self.options = wider_level(self.options, self.grid.rms)
        self._unmapped = Unmapped(self.grid, self.options)
        x, P = prior(self._claimed)
        x[:4], P[:4, :4] = self.alone_x, self.alone
        # Dead reckoning's own covariance, widened by the radius of this search.
        P[:2, :2] += (self._reach() * SEARCH_SPREADS[self._searches % len(SEARCH_SPREADS)]) ** 2 * np.eye(2)
        self._searches += 1
        self._jump(x, Verdict.NOWHERE.value)
        level = self.options.bias_sigma
        self._filter = Bank(self.grid, x, P, self._resolution, self.options.gate, level)
        self.x, self.P = x, P

    def _compact(self, width: float) -> bool:
        """Return True if a position of 1-sigma `width` (m) counts as one place on the scale of the map."""
        return width <= max(SPLIT_SPREAD * self._resolution, 0.25 * self.grid.correlation_length)

    def _reach(self) -> float:
        """Return the 1-sigma (m) with which a competing bank is spread around the filter at its start."""
        length = self.grid.correlation_length * (0.5 if self._unique else 1.0)
        return max(MIN_SEARCH_RADIUS_M, widest(self.alone), min(length, 5.0 * MIN_SEARCH_RADIUS_M))

    @property
    def informed(self) -> bool:
        """True if the field has made the position clearly more precise than dead reckoning alone."""
        return widest(self.P) <= MAX_INFORMED_RATIO * widest(self.alone)

    @property
    def is_lost(self) -> bool:
        """True if the field contradicts the map at the position, or a rival at another place is likelier."""
        return self._lost or any(
            log_odds > 0.0 and squared_mahalanobis(y - self.x[:2], self.P[:2, :2] + S) > ELSEWHERE
            for y, S, log_odds in self._all_rivals()
        )

    @property
    def _is_vague(self) -> bool:
        """True if the position may err by more than ``sigma_limit``; dead reckoning from a fix does not."""
        return min(widest(self.position_covariance), widest(self.alone)) > self.options.sigma_limit

    def _set_state(self, on_the_map: bool) -> None:
        """Change between one filter and a bank if the position's width requires it, and set the state."""
        width = widest(self.P)
        # Hysteresis between JOIN_SPREAD and SPLIT_SPREAD: the kind of filter does not alternate.
        assert self._filter is not None
        if self._filter.is_single and width > SPLIT_SPREAD * self._resolution:
            self._filter = self._estimator(self.x, self.P)
            self._monitor = None
        elif not self._filter.is_single and width < JOIN_SPREAD * self._resolution:
            self._filter = self._estimator(self.x, self.P)
        # A fix and the dead reckoning since then may be as precise as the map could be.
        limit = min(0.25 * self.grid.correlation_length, self.options.sigma_limit)
        tracks_from_fix = self._fixed and self._map_confirmed and widest(self.alone) <= limit
        if self.is_lost or (self._is_vague and self._known and on_the_map):
            self.state = NavigationState.LOST
        elif not self._compact(width):
            self.state = NavigationState.SEARCHING
        elif not tracks_from_fix and not (on_the_map and self.informed):
            self.state = NavigationState.DEAD_RECKONING
        else:
            self.state = NavigationState.TRACKING


def missing_variance(P: FloatArray, sigma: float) -> FloatArray:
    """Return the diagonal matrix that raises the variances of `P` to at least `sigma` squared."""
    return np.diag(np.maximum(sigma**2 - np.diag(P), 0.0))
