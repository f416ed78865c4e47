"""The navigator: it turns telemetry and corrected samples, in order of time, into positions with uncertainty.

It uses only event time and no random numbers, so that a replay gives the same bits. ::

    nav = Navigator(read_grid("grid.nc"), NavigationOptions(start_sigma=100.0))
    nav.fix(t_us, latitude, longitude)
    nav.telemetry(t_us, heading=90.0, speed=0.35, depth=40.0)
    record = nav.sample(t_us, corrected)        # None until enough samples make a measurement
    print(record.latitude, record.longitude, record.state.name)
"""

from __future__ import annotations

from math import isfinite, nan, sqrt

import numpy as np

from magbridge.field.geodesy import offset, separation, worse_axis
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.bank import widest
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.estimate import Estimate
from magbridge.navigate.gnss import UNSTATED_SIGMA_M, GnssMonitor, GnssState, Prediction
from magbridge.navigate.model import Block, Collector, block_length, transition
from magbridge.navigate.options import NavigationOptions, lasting_errors
from magbridge.navigate.record import NavigationState, Reckoned, Record
from magbridge.records import NEVER, Corrected, Quality

__all__ = ["NO_POSITION_FLAGS", "Navigator"]

NO_POSITION_FLAGS = int(Quality.SATURATED | Quality.UNCALIBRATED | Quality.LATE_JOIN)
MAX_SAMPLE_AGE_S = 10.0
"""Largest age of a usable sample relative to the dead-reckoned position, which cannot go back, s."""
MAX_UPDATE_AGE_INTERVALS = 3.0
"""Largest age of an update from which a position is still dead-reckoned, in intervals."""

MIN_HEIGHT_STEP_M, MAX_CLIMB_M_S, MAX_CLIMB_TIME_S = 10.0, 20.0, 60.0
"""Smallest step of the height that counts as a new origin: m, plus a vehicle's climb since the last height,
m/s, over at most this time, s."""
MAIN_FIELD_GRADIENT = 0.03
"""Largest change of the main field with height, nT/m: three times the field over the radius of the Earth."""
HEADING_AGE_US = 10_000_000
"""Time for which a poor heading makes the dead-reckoned velocity uncertain, µs."""
POOR_HEADING_SIGMA_RAD, MAX_HEADING_SIGMA_RAD = 0.15, 1.0
"""1-sigma of a heading, rad, above which motion by GNSS may differ from dead reckoning; and the largest one:
the direction is then unknown."""


class Navigator:
    """Estimator of the position from the total field and a map, relative to a dead-reckoned track.

    Attributes
    ----------
    estimate : Estimate
        Position relative to the dead-reckoned track, and its validity.
    gnss : GnssMonitor
        Test of the GNSS receiver's positions.
    dropped : int
        Number of samples that were dropped because they came out of time order, or too late.
    utc_offset_us : int
        Offset from the samples' times to UNIX time, µs; not 0 if the host's clock was set since the start.
    """

    def __init__(self, grid: AnomalyGrid, options: NavigationOptions | None = None) -> None:
        grid, options = lasting_errors(grid, options or NavigationOptions())
        self.estimate = Estimate(grid, options)
        self.gnss = GnssMonitor(grid, options)
        self.dropped = self.utc_offset_us = 0
        self._reckoning = DeadReckoning()
        self._collector = Collector(options, block_length(grid))
        self._latest_us = NEVER
        self._depth_us = NEVER
        self._heading_error = NEVER, 0.0  # time, µs; 1-sigma of the velocity, m/s

    def fix(
        self, time_us: int, latitude: float, longitude: float, sigma: float | None = None
    ) -> Record | None:
        """Start at a position, deg, or fuse it as a fix; return the update that this completes, or None.

        The update is from samples taken before. `sigma` is the position's 1-sigma on each axis, m; default
        ``options.start_sigma``.
        """
        return self._correct(time_us, (latitude, longitude), sigma, None)

    def gnss_position(
        self, time_us: int, latitude: float, longitude: float, sigma: float | None = None
    ) -> Record | None:
        """Test a GNSS position, and fuse it if it passes; return the update that this completes, or None.

        `sigma` is the 1-sigma that the receiver states on each axis, m; default :data:`UNSTATED_SIGMA_M`.
        :attr:`gnss` has the result of the test.
        """
        if not (isfinite(latitude) and isfinite(longitude)):
            return None
        place, monitor, estimate = (latitude, longitude), self.gnss, self.estimate
        known = UNSTATED_SIGMA_M if sigma is None else sigma
        self._reckoning.advance(time_us * 1e-6)
        if not estimate.begun:
            # Without an estimate to compare with, only the receiver's own report counts.
            wide, zero = np.eye(2) * 1e12, np.zeros(2)
            nothing = Prediction(zero, wide, wide, zero, estimate.options.current_sigma)
            state = monitor.check(time_us, place, (0.0, 0.0), known, nothing)
        else:
            where = self._reckoning
            away = separation(where.latitude, where.longitude, latitude, longitude)
            was_good = monitor.state is GnssState.GOOD
            state = monitor.check(time_us, place, away, known, self._prediction(time_us))
            # Positions that were fused before the fault was found may have been wrong.
            if was_good and state is not GnssState.GOOD and monitor.unaided is not None:
                estimate.replace(monitor.unaided, "a filter without the receiver's positions is likelier")
            estimate.rivals = monitor.rivals(time_us)
        if state is not GnssState.GOOD:
            return None
        return self._correct(time_us, place, known, monitor.fused_sigma(time_us, known))

    def _prediction(self, time_us: int) -> Prediction:
        """Return the predicted position at `time_us`, not earlier than the last update."""
        now, where = self.estimate, self._reckoning
        # Prediction of the state; the receiver's own deviation is measured relative to dead reckoning.
        F, Q = transition(now.options, max((time_us - now.time_us) * 1e-6, 0.0), 0.0)
        x, P = F @ now.x, F @ now.P @ F.T + Q
        current_sigma = worse_axis(P[2, 2], P[2, 3], P[3, 3])
        alone = (F[:4, :4] @ now.alone @ F[:4, :4].T + Q[:4, :4])[:2, :2]
        since_us, error = self._heading_error
        recent = time_us - since_us < HEADING_AGE_US
        return Prediction(
            x[:2], P[:2, :2], alone, x[2:4], float(current_sigma), error if recent else 0.0, where.travelled,
            where.speed, where.noise, now.is_lost, now.informed,
        )  # fmt: skip

    def _correct(
        self, time_us: int, place: tuple[float, float], sigma: float | None, fused_sigma: float | None
    ) -> Record | None:
        """Start at `place`, deg, or fuse it as a fix; return the update that this completes, or None.

        `sigma` (m) is for the start and the test of the fix, `fused_sigma` (m) for its fusion.
        """
        if not (isfinite(place[0]) and isfinite(place[1])):
            return None
        sigma = self.estimate.options.start_sigma if sigma is None else sigma
        where = self._reckoning
        where.advance(time_us * 1e-6)
        if not self.estimate.begun:
            where.place(*place)
            self._collector.flush()  # drops samples that were taken at another place
            self.estimate.start(time_us, sigma)
            return None
        record = self.finish()
        self.estimate.predict(time_us, where.travelled, where.noise)
        # The filter's state is the offset from dead reckoning, so a fix enters as such an offset.
        there = np.array(separation(where.latitude, where.longitude, *place))
        self.estimate.correct(there, sigma, fused_sigma)
        return record

    def telemetry(self, time_us: int, **values: float) -> None:
        """Update dead reckoning with telemetry; names and units are as in :meth:`DeadReckoning.telemetry`.

        A step of the depth that no vehicle makes changes the origin of the heights. The estimated bias then
        contains the main field's error before it or after it.
        """
        depth = values.get("depth", nan)
        if isfinite(depth):
            step = abs(depth - self._reckoning.depth)
            elapsed = 0.0 if self._depth_us == NEVER else (time_us - self._depth_us) * 1e-6
            self._depth_us = time_us
            if step > MIN_HEIGHT_STEP_M + MAX_CLIMB_M_S * min(elapsed, MAX_CLIMB_TIME_S):
                self._collector.flush()
                self.estimate.widen_bias(MAIN_FIELD_GRADIENT * step)
                self.gnss.new_height()
        self._reckoning.telemetry(time_us * 1e-6, values)

    def new_motion(self, time_us: int) -> None:
        """Prepare for a new source of motion from `time_us` on: forget the old one, widen the current."""
        self._reckoning.advance(time_us * 1e-6)
        self._reckoning.forget()
        self.estimate.widen_current(self.estimate.options.current_sigma)
        self.gnss.new_motion()

    def widen_heading(self, time_us: int, sigma: float) -> None:
        """Widen the current to the effect of a heading error of 1-sigma `sigma`, rad, from `time_us` on."""
        self._reckoning.advance(time_us * 1e-6)
        error = min(sigma, MAX_HEADING_SIGMA_RAD) * self._reckoning.speed
        self._heading_error = time_us, error if sigma > POOR_HEADING_SIGMA_RAD else 0.0
        self.estimate.widen_current(error)

    def sample(self, time_us: int, corrected: Corrected) -> Record | None:
        """Add a corrected sample; return the update that this completes, or None."""
        if corrected.quality & NO_POSITION_FLAGS:
            return None
        return self.measure(time_us, corrected.total_field, corrected.total_field_sigma)

    def measure(self, time_us: int, total_field: float, sigma: float) -> Record | None:
        """Add a total field and its 1-sigma, nT; return the update that this completes, or None.

        The navigator ignores a sample that is NaN, not later than the previous sample, older than the
        dead-reckoned position by more than :data:`MAX_SAMPLE_AGE_S`, or earlier than the first position.
        """
        if self.estimate.state is NavigationState.OFF or not isfinite(total_field + sigma):
            return None
        where = self._reckoning
        if time_us <= self._latest_us or time_us * 1e-6 < where.time - MAX_SAMPLE_AGE_S:
            self.dropped += 1
            return None
        self._latest_us = time_us
        where.advance(time_us * 1e-6)
        block = self._collector.add(time_us, where, total_field, sigma, self.utc_offset_us)
        return None if block is None else self._update(block)

    def finish(self) -> Record | None:
        """Update with the samples collected so far and return the record; None without samples."""
        block = self._collector.flush()
        return None if block is None else self._update(block)

    def reckon(self, time_us: int) -> Reckoned | None:
        """Return the position at `time_us`, dead-reckoned from the last update; the filter does not change.

        Return None if the last update is invalid or too old, or the position is too uncertain.
        """
        last = self.estimate
        elapsed = (time_us - last.time_us) * 1e-6
        if not last.valid or elapsed > MAX_UPDATE_AGE_INTERVALS * last.options.interval:
            return None
        F, Q = transition(last.options, max(elapsed, 0.0), 0.0)
        x, P = F @ last.x, F @ last.P @ F.T + Q
        position = P[:2, :2] + last.position_covariance - last.P[:2, :2]
        # Do not send a position that has become too uncertain since the valid update.
        if widest(P) > last.options.sigma_limit:
            return None
        place = offset(*self.reckoned(time_us), float(x[0]), float(x[1]))
        (nn, ne), (_, ee) = position.tolist()
        return Reckoned(time_us, *place, nn, ne, ee)

    def reckoned(self, time_us: int) -> tuple[float, float]:
        """Return latitude and longitude, deg, by dead reckoning alone at `time_us`."""
        return self._reckoning.extrapolate(time_us * 1e-6)

    def _update(self, block: Block) -> Record:
        now, where = self.estimate, self._reckoning
        # Estimate first; then the receiver's test uses the same measurement and its likelihood.
        seen = now.update(block, where.travelled, where.noise)
        if isfinite(seen.anomaly):
            self.gnss.observe(block, now.step, seen.log_likelihood, now.x, now.P)
        now.rivals = self.gnss.rivals(block.time_us)
        north, east, current_north, current_east, bias, map_error = now.x.tolist()
        latitude, longitude = offset(block.latitude, block.longitude, north, east)
        (nn, ne), (_, ee) = now.position_covariance.tolist()
        return Record(
            time_us=block.time_us, state=now.state, valid=now.valid, latitude=latitude, longitude=longitude,
            covariance_nn=nn, covariance_ne=ne, covariance_ee=ee, innovation=seen.value,
            innovation_variance=seen.variance, gate=now.options.gate, accepted=seen.accepted,
            depth=block.depth, anomaly=block.anomaly, map_anomaly=seen.anomaly, bias=bias,
            bias_sigma=sqrt(now.P[4, 4]), map_error=map_error, current_north=current_north,
            current_east=current_east, north=north, east=east, hypotheses=now.hypotheses, odds=now.odds,
        )  # fmt: skip
