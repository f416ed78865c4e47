"""Export the compensation of a scalar magnetometer as C99: one header and one source, without allocation.

The terms are those of :func:`magbridge.calibration.scalar.scalar_design`, in the same order.
"""

from __future__ import annotations

from string import Template

import numpy as np

from magbridge.calibration.export_c import hexadecimal, reals, rows
from magbridge.calibration.scalar import CYCLE_LEVEL_SIGMA_NT, RANGE_MARGIN, ScalarSensor

__all__ = ["scalar_header", "scalar_source"]

SCALAR_HEADER = Template("""/* Made by magbridge export: compensation of the scalar magnetometer $column.
 * Do not edit.
 *
 * Compile with -DMAGBRIDGE_FLOAT for float; otherwise double. No allocation, no state.
 */
#ifndef MAGBRIDGE_SCALAR_H
#define MAGBRIDGE_SCALAR_H

#ifdef MAGBRIDGE_FLOAT
typedef float magbridge_scalar_real;
#else
typedef double magbridge_scalar_real;
#endif

#define MAGBRIDGE_SCALAR_CHANNELS $count
$names
typedef struct {
    magbridge_scalar_real field, sigma, level_sigma; /* nT */
    int extrapolated; /* a channel is outside the range that was calibrated */
} magbridge_scalar_corrected;

/* reading: nT, as read; vector: the corrected vector, nT; turn: rate of its unit vector, 1/s; rate: rate of
 * the reading, nT/s; channels: in the order and the units above; same_power_cycle: 1 as long as the sensor
 * has not been switched off since the calibration, else 0: its level is then not known. */
void magbridge_correct_scalar(magbridge_scalar_real reading, const magbridge_scalar_real vector[3],
                              const magbridge_scalar_real turn[3], magbridge_scalar_real rate,
                              const magbridge_scalar_real *channels, int same_power_cycle,
                              magbridge_scalar_corrected *out);

#endif
""")

SCALAR_SOURCE = Template("""/* Made by magbridge export: do not edit. */
#include "magbridge_scalar.h"

#include <math.h>

typedef magbridge_scalar_real real;
#ifdef MAGBRIDGE_FLOAT
#define ROOT(x) sqrtf(x)
#else
#define ROOT(x) sqrt(x)
#endif

#define TERMS $terms

$tables

void magbridge_correct_scalar(real reading, const real vector[3], const real turn[3], real rate,
                              const real *channels, int same_power_cycle, magbridge_scalar_corrected *out)
{
    static const int row[6] = {0, 1, 2, 0, 0, 1}, column[6] = {0, 1, 2, 1, 2, 2};
    real a[TERMS + 1], u[3], field = reading, variance = $noise;
    const real length = ROOT(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
    int i, j, n = 0;

    for (i = 0; i < 3; i++)
        a[n++] = u[i] = vector[i] / length;
    for (i = 0; i < 6; i++)
        a[n++] = (real)(row[i] == column[i] ? 1 : 2) * u[row[i]] * u[column[i]] * length / $field;
    for (i = 0; i < 3; i++)
        for (j = 0; j < 3; j++)
            a[n++] = u[i] * turn[j];
    a[n++] = rate;
    out->extrapolated = 0;
    for (i = 0; i < MAGBRIDGE_SCALAR_CHANNELS; i++) {
        const real z = (channels[i] - channel[i][0]) / channel[i][1];
        if (!(channels[i] >= channel[i][2] && channels[i] <= channel[i][3]))
            out->extrapolated = 1;
        for (j = 0; j < 3; j++)
            a[n++] = z * u[j];
    }
    a[n] = (real)(same_power_cycle != 0);
    out->level_sigma = same_power_cycle ? ROOT(covariance[n][n]) : $level_sigma;
    if (!same_power_cycle)
        variance += out->level_sigma * out->level_sigma;
    for (i = 0; i <= TERMS; i++) {
        real sum = (real)0;
        for (j = 0; j <= TERMS; j++)
            sum += covariance[i][j] * a[j];
        field -= a[i] * mean[i];
        variance += a[i] * sum;
    }
    out->field = field;
    out->sigma = ROOT(variance > (real)0 ? variance : (real)0);
    if (out->level_sigma > out->sigma)
        out->level_sigma = out->sigma;
}
""")


def scalar_header(sensor: ScalarSensor) -> str:
    """Return ``magbridge_scalar.h``."""
    lines = [
        f"/* channel {k}: {one.name} [{one.unit or '1'}], from {one.low!r} to {one.high!r}".replace("*/", "")
        + " */"
        for k, one in enumerate(sensor.channels)
    ]
    column = sensor.column.replace("*/", "")
    return SCALAR_HEADER.substitute(column=column, count=len(sensor.channels), names="\n".join(lines))


def scalar_source(sensor: ScalarSensor) -> str:
    """Return ``magbridge_scalar.c``, with the level of the last power cycle that was fitted."""
    sensor = sensor.without_shift()
    size = len(sensor.coefficients) - len(sensor.power_cycles)
    # The terms and one level: those of the other power cycles are left out.
    kept = [*range(size), len(sensor.coefficients) - 1]
    covariance = [
        [hexadecimal(value) for value in row] for row in sensor.total_covariance[np.ix_(kept, kept)]
    ]
    channel = [["(real)0", "(real)1", "(real)0", "(real)0"]]
    if sensor.channels:
        channel = []
        for one in sensor.channels:
            margin = RANGE_MARGIN * (one.high - one.low)
            numbers = one.centre, one.scale, one.low - margin, one.high + margin
            channel.append([hexadecimal(number) for number in numbers])
    tables = [
        reals("mean[TERMS + 1]", [sensor.coefficients[k] for k in kept]),
        rows("real", "channel[][4]", channel),
        rows("real", "covariance[TERMS + 1][TERMS + 1]", covariance),
    ]
    return SCALAR_SOURCE.substitute(
        terms=size,
        tables="\n".join(tables),
        noise=hexadecimal(sensor.noise.white**2 + sensor.slow_variance),
        field=hexadecimal(sensor.reference_field),
        level_sigma=hexadecimal(CYCLE_LEVEL_SIGMA_NT),
    )
