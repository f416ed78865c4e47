/* Made by magbridge export: do not edit. */
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
