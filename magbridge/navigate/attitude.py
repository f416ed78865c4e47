"""Attitude from gyro rates and the measured field's direction, for an autopilot whose own attitude is wrong.

A wrong GPS position disturbs the autopilot's estimate of tilt, heading and gyro bias. The rates of its gyros
without that bias, and the direction of the field, remain right. They determine the attitude except for a slow
drift about the field's direction.
"""

from __future__ import annotations

from math import atan2, cos, exp, inf, pi, sin, sqrt

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.model import rotation_matrix, skew

__all__ = ["AttitudeFilter"]

MAX_FIELD_ANGLE_RAD = 0.05
"""Largest angle between the measured field, rotated by the autopilot's attitude, and the main field with
which this attitude counts as right, rad."""
RECOVERY_TIME_S = 60.0
"""Time after a contradiction in which the autopilot's attitude must agree with the field to be used, s."""
ANGLE_TIME_S = 3.0
"""Time constant of the means of that angle, and of the filter's squared innovation, s."""
RATE_NOISE_RAD_SQRT_S = 0.01
"""Random walk of the integrated rates, rad/sqrt(s)."""
SAMPLING_FRACTION = 0.03
"""Error of the integrated rates, as a fraction of their change between two reports."""
BIAS_DRIFT_RAD_S, AUTOPILOT_DRIFT_RAD_S = 5e-4, 1e-2
"""Random walk of the gyro bias, and of the autopilot's estimate of it while its attitude is wrong, rad/s per
sqrt(s)."""
DIRECTION_SIGMA_RAD, DIRECTION_DELAY_S = 0.03, 0.02
"""1-sigma of the field's direction, rad, and of the time between field and rates, s."""
ATTITUDE_SIGMA_RAD = 0.3
"""1-sigma of one report of the autopilot's attitude, rad: errors of successive reports are correlated."""
OFFSET_WEIGHT = 0.3
"""Weight of a new difference between the gyros' rates and the autopilot's, in their running mean."""
MAX_RATE_INTERVAL_S = 5.0
"""Longest time over which rates are integrated, s."""


class AttitudeFilter:
    """Extended Kalman filter of the attitude error (north, east, down) and of the gyro bias (body axes).

    `agrees` is True if the autopilot's attitude is used: its filter does not contradict its sensors, and soon
    after it did, the attitude agrees with the direction of the field.

    Notes
    -----
    With the matrix C from body to north-east-down and the rates w, ``C' = C exp([w - b] dt)``. A small error
    e of C rotates a direction by ``e × direction`` (multiplicative filter; Lefferts et al. 1982).
    """

    def __init__(self) -> None:
        self.agrees = True
        self._C = np.eye(3)
        self._bias = np.zeros(3)
        self._offset = np.zeros(3)  # rates of the gyros minus those of the autopilot, rad/s
        self._P = np.diag(np.square([pi, pi, pi, 0.02, 0.02, 0.02]))
        self._rates = np.zeros(3)
        self._time = -inf  # s, of the last report
        self._received = -inf
        self._contradicted = -inf  # time of the last contradiction, s
        self._compared = -inf  # time of the last comparison of the gyros' rates with the autopilot's, s
        self._gyro = -inf, np.zeros(3)  # last rates of the gyros and their time
        self._directed = -inf
        self._autopilot = np.eye(3)
        self._angle = self._excess = 0.0

    @property
    def heading(self) -> float:
        """Heading, rad."""
        return atan2(self._C[1, 0], self._C[0, 0])

    @property
    def heading_sigma(self) -> float:
        """1-sigma of the heading, rad; it includes the excess of the innovations over their covariance."""
        return sqrt(self._P[2, 2] * max(1.0, self._excess))

    def rotate(
        self,
        received: float,
        time: float,
        angles: tuple[float, float, float],
        rates: FloatArray,
        *,
        vouched: bool,
    ) -> None:
        """Integrate rates (3,), rad/s in body axes, and use the autopilot's attitude where it is right.

        `received` is the time of reception and `time` that of the vehicle's clock, s. `angles` are roll,
        pitch and yaw, rad. `vouched` is False if the autopilot's filter contradicts its own sensors.
        """
        self._autopilot = rotation(*angles)
        if not 0.0 < time - self._time < MAX_RATE_INTERVAL_S:
            self._C, self._rates, self._time, self._received = self._autopilot, rates, time, received
            self._P[:3, :3] = np.eye(3) * ATTITUDE_SIGMA_RAD**2
            self.agrees = vouched
            return
        # Mean of two successive rates, corrected for the autopilot's bias and for the gyros' own.
        seconds = time - self._time
        then, gyro = self._gyro
        if self._time <= then <= time:
            reported = self._rates + (then - self._time) / seconds * (rates - self._rates)
            # The autopilot's bias changed since the last such difference: the rates between were wrong.
            changed = self._C @ (gyro - reported - self._offset)
            wrong_s = 4.0 * min(time - self._compared, MAX_RATE_INTERVAL_S)
            self._P[:3, :3] += np.outer(changed, changed) * wrong_s**2
            self._offset += OFFSET_WEIGHT * (gyro - reported - self._offset)
            self._compared = then
        drift = (
            BIAS_DRIFT_RAD_S
            if time - self._compared < MAX_RATE_INTERVAL_S or self.agrees
            else AUTOPILOT_DRIFT_RAD_S
        )
        mean = 0.5 * (rates + self._rates) + self._offset - self._bias
        F = np.eye(6)
        F[:3, 3:] = -seconds * self._C
        self._P = F @ self._P @ F.T
        sampling = SAMPLING_FRACTION * seconds * np.linalg.norm(rates - self._rates)
        self._P[:3, :3] += np.eye(3) * (RATE_NOISE_RAD_SQRT_S**2 * seconds + sampling**2)
        self._P[3:, 3:] += np.eye(3) * drift**2 * seconds
        self._C = self._C @ rotation_matrix(mean * seconds)
        self._rates, self._time, self._received = rates, time, received
        if not vouched:
            self._contradicted = time
        # After a contradiction, the attitude must also agree with the field; a boresight that is wrong at all
        # times does not count.
        recovers = time - self._contradicted < RECOVERY_TIME_S
        self.agrees = vouched and not (recovers and self._angle > MAX_FIELD_ANGLE_RAD)
        if self.agrees:
            error = self._autopilot @ self._C.T
            small = 0.5 * np.array(
                [error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]
            )
            if np.trace(error) < 1.0:  # more than 90 degrees: the filter itself is wrong
                self._C, self._P[:3, :3] = self._autopilot, np.eye(3) * ATTITUDE_SIGMA_RAD**2
            else:
                self._correct(small, np.eye(3), ATTITUDE_SIGMA_RAD)

    def gyro(self, time: float, rates: FloatArray) -> None:
        """Use the rates (3,) of the gyros themselves, rad/s in body axes, at `time` (s)."""
        self._gyro = time, rates

    def direct(self, received: float, field: FloatArray, main: FloatArray) -> None:
        """Use the directions of a sample's corrected field (3,), body axes, and of the main field (3,).

        `main` is in north-east-down axes, and `received` the time of the sample, s. The filter ignores
        directions between two reports of the rates.
        """
        since = received - self._received
        if self._directed == self._time or abs(since) > 1.0:
            return
        self._directed = self._time
        body, expected = field / np.linalg.norm(field), main / np.linalg.norm(main)
        turned = rotation_matrix(self._rates * since) @ body
        weight = 1.0 - exp(-0.1 / ANGLE_TIME_S)
        angle = sqrt(float(np.sum(np.square(np.cross(self._autopilot @ turned, expected)))))
        self._angle += weight * (angle - self._angle)
        measured = self._C @ turned
        sigma = DIRECTION_SIGMA_RAD + DIRECTION_DELAY_S * float(np.linalg.norm(self._rates))
        # expected - measured = e × measured = -[measured]× e
        squared = self._correct(expected - measured, -skew(measured), sigma)
        self._excess += weight * (0.5 * squared - self._excess)

    def _correct(self, residual: FloatArray, jacobian: FloatArray, sigma: float) -> float:
        """Update with a residual (3,) of the attitude error; return its squared Mahalanobis distance."""
        H = np.hstack([jacobian, np.zeros((3, 3))])
        S = H @ self._P @ H.T + sigma**2 * np.eye(3)
        K = np.linalg.solve(S, H @ self._P).T
        change = K @ residual
        squared = float(residual @ np.linalg.solve(S, residual))
        self._P = (np.eye(6) - K @ H) @ self._P
        self._P = 0.5 * (self._P + self._P.T)
        self._C = rotation_matrix(change[:3]) @ self._C
        self._bias = self._bias + change[3:]
        return squared


def rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the matrix from body axes to north-east-down, from angles in rad."""
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )
