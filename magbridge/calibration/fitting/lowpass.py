r"""Undo an anti-alias filter before a fit: while the vehicle turns, it attenuates the field a little.

Notes
-----
An RC filter of corner f_c gives y with :math:`\mathbf y + τ \dot{\mathbf y} = \mathbf x`,
:math:`τ = 1/(2 π f_c)`. A field that rotates in the sensor's axes is not only delayed but also shortened::

    |y| = |x| - tau^2 |dx/dt|^2 / (2 |x|)

The calibration keeps the corner, so that correcting undoes the filter, too (:mod:`magbridge.filter_lag`):
there without samples that are still to come.

With the paper's 0.33 Hz, in a spiral of four minutes a turn, that is 0.7 nT: little, but all of it goes into
the gain, and from there into every sample of a straight survey.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.errors import CalibrationError

__all__ = ["unfiltered"]

MIN_SLOPE_TIME_CONSTANTS = 4.0
"""Time constants that a slope spans at least: over shorter spans it would be noise."""


def unfiltered(data: Observations, corner: float) -> Observations:
    """Return `data` as they would be without a first-order filter of that corner.

    `data`: as the filter passed them on. `corner`: Hz.

    CalibrationError: the time constant of the filter is longer than the data.
    """
    if len(data) < 3:
        return data
    tau = 1.0 / (2.0 * np.pi * corner)
    duration = float(np.ptp(data.time))
    if tau > duration:
        raise CalibrationError(
            f"filter corner = {corner:g} Hz: its time constant of {tau:.3g} s is longer than the data "
            f"({duration:.3g} s)"
        )
    reach = max(int(np.ceil(0.5 * MIN_SLOPE_TIME_CONSTANTS * tau / np.median(np.diff(data.time)))), 1)
    stretch = np.cumsum(data.steps != 1)
    rows = np.arange(len(data))
    ahead, behind = np.minimum(rows + reach, len(data) - 1), np.maximum(rows - reach, 0)
    # a slope does not reach into another run; at an end it looks one way only
    ahead = np.where(stretch[ahead] == stretch, ahead, rows)
    behind = np.where(stretch[behind] == stretch, behind, rows)
    apart = data.time[ahead] - data.time[behind]
    rise: FloatArray = data.field[ahead] - data.field[behind]
    slope = np.divide(rise, apart[:, None], out=np.zeros_like(rise), where=apart[:, None] > 0.0)
    return replace(data, field=data.field + tau * slope, filter_cutoff=corner)
