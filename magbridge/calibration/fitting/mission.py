"""How well a calibration will do on a mission: its uncertainty at the attitudes and positions met there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.forward import forward
from magbridge.calibration.model import Calibration, Noise
from magbridge.errors import CalibrationError

__all__ = ["Mission", "expected_error", "nearby_mission"]

MISSION_SAMPLES = 600
"""Samples that represent a mission."""
ROLL = 10.0
"""deg either way, by which a survey rolls further than the runs did."""


@dataclass(frozen=True, eq=False)
class Mission:
    """The fields and positions that a mission meets."""

    field_body: FloatArray
    """(n, 3), nT, the true field in body axes."""
    parameters: FloatArray
    """(n, k): Actuator positions at the same samples, in their units."""

    @classmethod
    def from_observations(cls, data: Observations) -> Mission:
        """Return the mission with the attitudes and positions of a deployment.

        CalibrationError: attitude or place is missing.
        """
        # the true field in body axes needs attitude and direction
        known, attitude, reference_ned = data.directed()
        if not known.any():
            raise CalibrationError(
                "the mission has no sample with all of roll, pitch, heading, latitude and longitude"
            )
        part = slice(None, None, max(len(attitude) // MISSION_SAMPLES, 1))
        return cls(field_body(attitude[part], reference_ned[part]), data.parameters[known][part])


def nearby_mission(calibration: Calibration, data: Observations) -> Mission:
    """Return the calibration's own attitudes and positions, rolled a little further, on all headings.

    A survey after these runs meets at least those. Rolling needs only the corrected vectors. Turning to other
    headings needs the vertical, which attitude telemetry gives: without it, only the runs' headings are used.
    """
    rows = np.arange(0, len(data), max(3 * len(data) // MISSION_SAMPLES, 1))
    k = len(calibration.parameters)
    positions = data.parameters[rows, :k]
    b = correct(calibration, data.field[rows], positions, data.time[rows]).vector
    # roll a little further each way
    met = [Rotation.from_euler("X", angle, degrees=True).apply(b) for angle in (-ROLL, 0.0, ROLL)]
    places = [positions] * len(met)
    if data.attitude is not None:
        known = np.isfinite(data.attitude[rows]).all(axis=1)
        attitude = Rotation.from_euler("ZYX", data.attitude[rows[known], ::-1])
        # and turn about the vertical, by attitude
        down = attitude.apply([0.0, 0.0, 1.0], inverse=True)
        met += [
            Rotation.from_rotvec(np.radians(angle) * down).apply(b[known]) for angle in range(60, 360, 60)
        ]
        places += [positions[known]] * (len(met) - len(places))
    return Mission(np.concatenate(met), np.concatenate(places))


def expected_error(calibration: Calibration, mission: Mission) -> FloatArray:
    """Return the 1-sigma (nT) of the corrected total field from the position terms alone, without noise.

    The result is (n,).
    """
    # forward to the reading and back: the sigma of the way back is that of the position terms
    model = replace(calibration.without_effects(), noise=Noise(0.0), boresight=None)
    truth = mission.field_body
    if calibration.boresight is not None:
        truth = truth @ calibration.boresight.matrix()
    time = np.zeros(len(truth))
    reading = forward(model, truth, mission.parameters, time)
    return correct(model, reading, mission.parameters, time).sigma
