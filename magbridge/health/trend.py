r"""Check whether the total field leaves its own trend.

The corrected total field does not depend on the attitude, and it changes slowly with the position. A Kalman
filter follows its level L and its slope s, as an integrated random walk of intensity q (Bar-Shalom, Li &
Kirubarajan 2001, *Estimation with Applications to Tracking and Navigation*, section 6.2.2):

.. math:: F = \begin{pmatrix} 1 & T \\ 0 & 1 \end{pmatrix}, \quad
          Q = q \begin{pmatrix} T^3/3 & T^2/2 \\ T^2/2 & T \end{pmatrix} + \sigma^2 |\Delta u|\, e_1 e_1^T

A crustal field of standard deviation :math:`\sigma_c` and correlation length :math:`\ell` (Matern, smoothness
3/2), crossed at the speed v, has :math:`q = 4 (\sqrt 3 v / \ell)^3 \sigma_c^2`. This value is the lower
bound of q, which adapts to the normalised innovations. The second term of Q models the change of the
calibration's error while the direction of the field turns by :math:`|\Delta u|`.

A sample whose innovation exceeds :data:`GATE_SIGMA` is an outlier (section 5.4 of the same book). Three
outliers that agree with each other are a jump. Samples after a jump are flagged until the field has returned:
the sum of the jumps is zero, or the level is again that before the jumps. Sigma includes the largest jump,
also for a while after the return.

Telemetry reports a motion, or another change of a parameter, after the change has begun. The filter then
returns to its state before the change, so that it does not count the effect of the change as a jump. The
message about a jump waits until the telemetry is newer than the jump.
"""

from __future__ import annotations

from collections import deque
from math import exp, log, nan
from typing import Final, NamedTuple

from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.health.checks import Messages
from magbridge.health.scatter import Scatter
from magbridge.records import NEVER

GATE_SIGMA: Final = 7.0
"""Innovation above which a sample is an outlier, in sigmas. Gaussian noise exceeds 5.5 once a month."""
GATE: Final = GATE_SIGMA * GATE_SIGMA
CRUST_LENGTH_M: Final = 1000.0
CURVATURE_PER_SPEED_CUBED: Final = 4.0 * (3.0**0.5 / CRUST_LENGTH_M) ** 3 * MAIN_FIELD_SIGMA_NT**2
"""Ratio of q to the cube of the speed for a crustal field, nT²/m³."""
MIN_INTENSITY: Final = 1e-4
"""Value of q while the speed is unknown, nT²/s³: the slope changes by 0.05 nT/s in half a minute."""
SLOPE_NT_PER_S: Final = 0.5
"""Initial 1-sigma of the slope, nT/s."""
ADAPTATION: Final = 0.02
"""Gain of the adaptation of log q to a normalised squared innovation."""
MAX_TREND_SQUARE: Final = 16.0
"""Upper bound of the normalised squared innovation that adapts q."""
AGREEING: Final = 3
"""Number of agreeing outliers that are a jump, and of accepted samples that establish a new trend."""
ESTABLISHED_SAMPLES: Final = 256
"""Number of accepted samples after which q counts as known although the speed is unknown."""
LARGE_CHANGE: Final = 2.0
"""Decrease of the lower bound of log q, by a new speed, above which log q restarts near the bound."""
SPIKE_DECAY: Final = 0.3
BURST_DECAY: Final = 0.8
BURST_SAMPLES: Final = 8
"""Fraction of an outlier's square that is added to the next sample's variance: after a spike, and in a burst.
Outliers within BURST_SAMPLES samples are a burst."""
RETURN: Final = 4.0
EVIDENT: Final = 16.0
"""Normalised square of the distance from the level before the jumps up to which the field has returned, and
square of the smallest ratio of a jump to this distance: a smaller jump does not show a return."""
CAUTION: Final = 0.75
"""Factor for the size of the jump if the return is gradual, because a drifting level may pass that before."""
LASTING_US: Final = 120_000_000
"""Duration above which a jump counts as lasting, µs."""
TREND_HOLD_US: Final = 60_000_000
MAX_HOLD_US: Final = 3_600_000_000
MAX_MOTION_HOLD_US: Final = 86_400_000_000
"""Time for which sigma includes a jump that has ended, µs: initial, largest, largest after motions."""
LATE_US: Final = 500_000
"""Largest delay of telemetry that the message about a jump allows for, µs."""
CHECKPOINT_US: Final = 1_000_000
CHECKPOINTS: Final = 64


class TrendState(NamedTuple):
    """State of the trend filter: level (nT), slope (nT/s), their covariance, and the jumps so far.

    The jumps have the sum `jump_sum` (nT) since the field left its level at `since_us` (µs). Sigma includes
    the largest jump, `largest` (nT), until `until_us` (µs).
    """

    time_us: int
    level: float
    slope: float
    p_level: float
    p_cross: float
    p_slope: float
    jump_sum: float
    largest: float
    jumps: int
    since_us: int
    until_us: int


class NewJump(NamedTuple):
    """Jump that telemetry may still explain: its size (nT), the state before it, and its message.

    Telemetry from `until_us` (µs) on explains it no more.
    """

    until_us: int
    jump: float
    before: TrendState
    kind: str
    text: str


class TrendCheck:
    """Filter of the total field's trend that finds outliers and jumps; `scatter` estimates the noise.

    `is_outlier` is True if the last sample is an outlier, `has_moved` if a mass may have moved since the last
    sample, `is_away` if the field has jumped and not returned.
    """

    def __init__(self, scatter: Scatter, messages: Messages) -> None:
        self._scatter, self._messages = scatter, messages
        self.is_outlier = self.has_moved = self.is_away = False
        self._now: TrendState | None = None
        self._checkpoints: deque[TrendState] = deque(maxlen=CHECKPOINTS)
        self._sigma = 0.0
        self._log_q = log(MIN_INTENSITY)
        self._min_log_q = log(MIN_INTENSITY)
        self._has_speed = False
        self._slope_variance = SLOPE_NT_PER_S**2
        self._before = nan  # prediction, if only a turn or a motion made the last sample acceptable
        self._accepted = 0
        self._unrest, self._decay, self._quiet = 0.0, SPIKE_DECAY, BURST_SAMPLES
        self._candidate, self._agreed, self._candidate_us = nan, 0, NEVER
        self._new: NewJump | None = None
        self._home: TrendState | None = None  # prediction at which the field left its level
        self._away_us = NEVER  # time at which the field was last seen not to be back there

    @property
    def is_established(self) -> bool:
        """Return True if the field's rate of change is known, from the speed or from the samples."""
        return self._has_speed or self._accepted >= ESTABLISHED_SAMPLES

    @property
    def crossing_speed(self) -> float:
        """Speed (m/s) at which a typical crustal field would change as fast as the total field does."""
        return float((exp(max(self._log_q, self._min_log_q)) / CURVATURE_PER_SPEED_CUBED) ** (1.0 / 3.0))

    def set_speed(self, speed: float) -> None:
        """Set the lower bound of q, and the slope's variance, for the vehicle's speed, m/s."""
        floor = log(max(CURVATURE_PER_SPEED_CUBED * min(speed, 300.0) ** 3, 0.1 * MIN_INTENSITY))
        if floor < self._min_log_q - LARGE_CHANGE:  # the assumed speed was too high
            self._log_q = floor + LARGE_CHANGE
        self._min_log_q, self._has_speed = floor, True
        self._slope_variance = (
            max(SLOPE_NT_PER_S, 3.0**0.5 * MAIN_FIELD_SIGMA_NT / CRUST_LENGTH_M * speed) ** 2
        )

    def check(self, time_us: int, total: float, sigma: float, turned: float, *, learn: bool) -> float:
        """Update the trend with a sample; return the variance (nT²) that outliers add to the sample.

        `total` and `sigma` are the corrected total field and the part of its 1-sigma that is not common to
        all samples, nT; `turned` is the change of the field's direction since the last sample, rad. Without
        `learn`, the sample does not change the trend.
        """
        self.is_outlier = False
        scatter, now = self._scatter, self._now
        if now is None:
            if learn:
                self._begin(time_us, total, sigma, scatter.variance)
                scatter.begin(9.0 * max(sigma * sigma, scatter.floor))
            return 0.0
        noise = scatter.variance
        # prediction
        T = 1e-6 * (time_us - now.time_us)
        # q adapted to the innovations, at least that of the crustal field at this speed
        q = exp(max(self._log_q, self._min_log_q))
        level = now.level + T * now.slope
        p_slope = now.p_slope + q * T
        p_cross = now.p_cross + T * now.p_slope + 0.5 * q * T * T
        p_still = now.p_level + T * (2.0 * now.p_cross + T * now.p_slope) + q * T * T * T / 3.0
        p_level = p_still + sigma * sigma * min(turned, 2.0)
        if self.has_moved:
            p_level += sigma * sigma + self._sigma * self._sigma
        # variance of the innovation: level, turn or motion, and noise
        S = p_level + noise
        e = total - level
        scatter.follow(time_us, total)
        if not learn:  # a field that is known to be wrong would become the level, and its end a jump
            self.is_outlier = e * e > GATE * S
            return e * e if self.is_outlier else 0.0
        # now[6:] keeps the jumps so far; _replace would take twice as long
        if e * e <= GATE * S:
            # a sample accepted only because of a turn or a motion may still be an outlier
            self._before = level if e * e > GATE * (p_still + noise) else nan
            # Kalman gain and update of level and slope
            k_level, k_slope = p_level / S, p_cross / S
            kept = 1.0 - k_level
            p_slope = max(p_slope - k_slope * p_cross, 0.0)
            self._now = TrendState(
                time_us, level + k_level * e, now.slope + k_slope * e, p_level * kept, p_cross * kept,
                p_slope, *now[6:],
            )  # fmt: skip
            return self._accept(self._now, e * e / S, sigma, noise)
        if self._accepted < AGREEING:
            # which of the first samples is the outlier is not known
            if self.has_moved:
                self._jump(time_us, e, noise)
            self._begin(time_us, total, sigma, noise)
            self._accepted = 0
            return 0.0
        self._now = TrendState(time_us, level, now.slope, p_level, p_cross, p_slope, *now[6:])
        self._adapt(MAX_TREND_SQUARE)
        self._unrest = min(e * e, 16.0 * GATE * S)
        self._decay = BURST_DECAY if self._quiet < BURST_SAMPLES else SPIKE_DECAY
        self._quiet = 0
        self.is_outlier = True
        self._agree(time_us, total, sigma, S, noise)
        return e * e

    def _accept(self, state: TrendState, square: float, sigma: float, noise: float) -> float:
        """Record an accepted sample; return the variance that past outliers add, nT².

        `state` is the filter's state after the sample, `square` the normalised square of its innovation.
        """
        self._accepted += 1
        self._agreed = 0
        self._sigma, self.has_moved = sigma, False
        self._adapt(min(square, MAX_TREND_SQUARE))
        # states to return to when a motion is reported late
        checkpoints = self._checkpoints
        if not checkpoints or not 0 <= state.time_us - checkpoints[-1].time_us < CHECKPOINT_US:
            checkpoints.append(state)
        self._unrest = self._unrest * self._decay if self._unrest > noise else 0.0
        self._quiet += 1
        return self._unrest

    def _adapt(self, square: float) -> None:
        """Adapt q to a normalised squared innovation, whose mean is 1 if q is right."""
        self._log_q = max(self._log_q + ADAPTATION * (square - 1.0), self._min_log_q)

    def _begin(self, time_us: int, level: float, sigma: float, noise: float) -> None:
        """Restart the trend at a level (nT), but keep its slope and the jumps so far."""
        if self._now is None:
            self._now = TrendState(
                time_us, level, 0.0, noise, 0.0, self._slope_variance, 0.0, 0.0, 0, NEVER, NEVER
            )
        # the slope at the new level is unknown
        p_slope = max(self._now.p_slope, self._slope_variance)
        self._now = self._now._replace(
            time_us=time_us, level=level, p_level=noise, p_cross=0.0, p_slope=p_slope
        )
        self._sigma, self.has_moved = sigma, False

    def _agree(self, time_us: int, total: float, sigma: float, S: float, noise: float) -> None:
        """Record an outlier; if enough outliers agree, record a jump and restart the trend there."""
        # outliers that agree with each other are a new level
        difference = total - self._candidate
        if self._agreed and difference * difference <= GATE * S:
            self._agreed += 1
            self._candidate += 0.5 * difference
        else:
            self._candidate, self._agreed, self._candidate_us = total, 1, time_us
        if self._agreed == AGREEING:
            assert self._now is not None
            back = self._candidate - self._before
            if not back * back <= GATE * S:  # else the last accepted sample was the outlier
                self._jump(time_us, self._candidate - self._now.level, noise)
            self._begin(time_us, self._candidate, sigma, noise)
            self._agreed = 0

    def retract(self, since_us: int) -> None:
        """Restore the state before `since_us` (µs), because a change began that is reported only now."""
        if self._new is not None:  # by the times of arrival, the change may seem to be later than the jump
            since_us = min(since_us, self._new.before.time_us)
            self._now, self._new = self._new.before, None
        while self._checkpoints and self._checkpoints[-1].time_us > since_us:
            self._checkpoints.pop()
        if self._checkpoints and self._now is not None and self._now.time_us > since_us:
            self._now = self._checkpoints[-1]
        self._agreed, self._unrest, self._quiet = 0, 0.0, BURST_SAMPLES
        self.has_moved = True

    @property
    def is_waiting(self) -> bool:
        """True while telemetry may still explain a new jump."""
        return self._new is not None

    def follow_telemetry(self, time_us: int, total: float) -> None:
        """Retract a new jump if changed telemetry brings the `total` field back to the level before it."""
        if self._new is not None:
            before = self._new.before
            level = before.level + 1e-6 * (time_us - before.time_us) * before.slope
            if abs(total - level) < 0.5 * abs(self._new.jump):
                self.retract(before.time_us)

    def confirm(self, reported_us: int) -> None:
        """Report a new jump that telemetry of the time `reported_us` (µs) has not explained."""
        if self._new is not None and reported_us >= self._new.until_us:
            self._messages.report(self._new.kind, self._new.text)
            self._new = None

    def explain(self, difference: float) -> None:
        """Shift the level by `difference` (nT), by which a new calibration changes the total field."""
        if self._new is not None:
            self.confirm(self._new.until_us)
        if self._now is not None:
            self._now = self._now._replace(level=self._now.level + difference)
        if self._home is not None:
            self._home = self._home._replace(level=self._home.level + difference)
        self._candidate += difference
        self._checkpoints.clear()

    # -- jumps ---------------------------------------------------------------------------------------------

    def _jump(self, time_us: int, jump: float, noise: float) -> None:
        """Record a `jump` of the level (nT), and decide for how long sigma includes it."""
        now = self._now
        assert now is not None
        largest_zero, by_motion = GATE * noise, self.has_moved
        since_us, until_us = now.since_us, now.until_us
        # the time since the field left its level decides how long sigma includes the jump
        if now.jump_sum * now.jump_sum <= largest_zero:
            since_us, self._home = time_us, now
        elif time_us - since_us > LASTING_US:
            until_us = max(until_us, time_us + min(time_us - since_us, MAX_HOLD_US))
        total = now.jump_sum + jump
        # a jump equal to the sum so far: the return in between was missed, at a motion or a turn
        if jump * now.jump_sum > largest_zero and (jump - now.jump_sum) ** 2 <= 2.0 * largest_zero:
            total = jump
        slope = now.slope
        if self._home is not None and self._is_return(now, jump, total, noise):
            total, slope = 0.0, self._home.slope
        # a jump at a motion recurs at the next motion, so sigma includes it for longer
        hold, most = (MAX_HOLD_US, MAX_MOTION_HOLD_US) if by_motion else (TREND_HOLD_US, MAX_HOLD_US)
        until_us = max(until_us, time_us + min(hold << min(2 * now.jumps, 20), most))
        self._now = now._replace(
            slope=slope,
            jump_sum=total,
            largest=max(now.largest, abs(total), abs(jump)),
            jumps=now.jumps + 1,
            since_us=since_us,
            until_us=until_us,
        )
        kind, why = "jump", ", which no telemetry explains"
        if by_motion:
            kind, why = "move", " as telemetry changes: calibration or telemetry wrong"
        if self._new is None:
            text = f"field jumps by {jump:+.0f} nT{why}"
            self._new = NewJump(self._candidate_us + LATE_US, jump, now, kind, text)

    def _is_return(self, state: TrendState, jump: float, total: float, noise: float) -> bool:
        """Return True if a `jump` (nT) from `state` ends the jumps, whose sum is then `total`, nT."""
        # change of the level since the jump; if it is more than natural, the disturbance has changed, and
        # only the level shows the return; else the sum of the jumps shows it with a smaller error
        drift, P = self._from_home(state, state.level - state.jump_sum)
        if drift * drift <= P:
            return _is_at(total, noise + 2.0 * state.p_level, jump)
        return _is_at(drift + total, P, jump)

    def _from_home(self, state: TrendState, level: float) -> tuple[float, float]:
        """Return the difference of `level` (nT) from that before the jumps, and its variance, nT²."""
        home = self._home
        assert home is not None
        T = 1e-6 * (state.time_us - home.time_us)
        q = exp(self._min_log_q)
        # natural change since then: of the trend, or of a crustal field at the speed that has this q,
        # sigma_c^2 3 (v T / l)^2, and at most 2 sigma_c^2
        trend = home.p_level + T * (2.0 * home.p_cross + T * home.p_slope) + q * T * T * T / 3.0
        way = 3.0**0.5 / CRUST_LENGTH_M * (q / CURVATURE_PER_SPEED_CUBED) ** (1.0 / 3.0) * T
        crust = MAIN_FIELD_SIGMA_NT**2 * min(way * way, 2.0)
        change, P = (T * home.slope, trend) if trend < crust else (0.0, crust)
        return level - home.level - change, P + self._scatter.variance + 2.0 * self._sigma**2

    def jump_variance(self, time_us: int) -> float:
        """Set :attr:`is_away`; return the variance (nT²) that past jumps add to a sample."""
        self.is_away = False
        now = self._now
        if now is None or not now.jumps:
            return 0.0
        # the field has returned if the sum of the jumps is zero up to the noise
        self.is_away = now.jump_sum * now.jump_sum > GATE * self._scatter.variance
        if self.is_away and self._home is not None:
            # a gradual return: for a while at the level before the jumps, with the slope of a crustal field
            is_flat = now.slope * now.slope + now.p_slope <= RETURN * self._slope_variance
            if not is_flat or not _is_at(*self._from_home(now, now.level), CAUTION * now.largest):
                self._away_us = time_us
            elif time_us - self._away_us >= TREND_HOLD_US:
                self.is_away = False
                self._now = now = now._replace(jump_sum=0.0)
        if not self.is_away and time_us >= now.until_us:
            self._now = now._replace(jump_sum=0.0, largest=0.0)
            return 0.0
        return now.largest * now.largest

    def forget(self) -> None:
        """Forget all jumps, because a new calibration explains them."""
        if self._now is not None:
            self._now = self._now._replace(jump_sum=0.0, largest=0.0, jumps=0, until_us=NEVER)
        self._checkpoints.clear()


def _is_at(difference: float, variance: float, jump: float) -> bool:
    """Return True if a `difference` is zero up to its `variance`, and a `jump` is large against its sigma."""
    largest = RETURN * variance
    return difference * difference <= largest and jump * jump > EVIDENT * largest
