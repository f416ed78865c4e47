"""Export the compensation of a scalar magnetometer as C99: one header and one source, without allocation.

The terms are those of :func:`magbridge.calibration.scalar.scalar_design`, in the same order.
"""

from __future__ import annotations

import numpy as np

from magbridge.calibration.export_c import c_template, hexadecimal, inputs, reals, rows
from magbridge.calibration.scalar import CYCLE_LEVEL_SIGMA_NT, RANGE_MARGIN, ScalarSensor

__all__ = ["scalar_header", "scalar_source"]


def scalar_header(sensor: ScalarSensor) -> str:
    """Return ``magbridge_scalar.h``."""
    return c_template("magbridge_scalar.h").substitute(
        column=sensor.column.replace("*/", ""),
        count=len(sensor.channels),
        names=inputs("channel", sensor.channels),
    )


def scalar_source(sensor: ScalarSensor) -> str:
    """Return ``magbridge_scalar.c``, with the level of the last power cycle that was fitted."""
    sensor = sensor.without_shift()
    size = len(sensor.coefficients) - len(sensor.power_cycles)
    # The terms and one level: those of the other power cycles are left out.
    kept = [*range(size), len(sensor.coefficients) - 1]
    channel = []
    for one in sensor.channels:
        margin = RANGE_MARGIN * (one.high - one.low)
        channel.append([one.centre, one.scale, one.low - margin, one.high + margin])
    tables = [
        reals("mean[TERMS + 1]", [sensor.coefficients[k] for k in kept]),
        rows("channel[][4]", channel or [[0.0, 1.0, 0.0, 0.0]]),
        rows("covariance[TERMS + 1][TERMS + 1]", sensor.total_covariance[np.ix_(kept, kept)].tolist()),
    ]
    return c_template("magbridge_scalar.c").substitute(
        terms=size,
        tables="\n".join(tables),
        noise=hexadecimal(sensor.noise.white**2 + sensor.slow_variance),
        field=hexadecimal(sensor.reference_field),
        level_sigma=hexadecimal(CYCLE_LEVEL_SIGMA_NT),
    )
