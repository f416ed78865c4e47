/* Made by magbridge export from calibration $id: do not edit. */
#include "magbridge_calibration.h"

#include <math.h>

typedef magbridge_real real;
#ifdef MAGBRIDGE_FLOAT
#define ROOT(x) sqrtf(x)
#define SIZE(x) fabsf(x)
#else
#define ROOT(x) sqrt(x)
#define SIZE(x) fabs(x)
#endif

#define MONOMIALS $monomials
#define PRODUCTS $products

$tables

void magbridge_correct(const magbridge_real field[3], const magbridge_real *parameters,
                       const magbridge_real *conditions, magbridge_corrected *out)
{
    real phi[MONOMIALS], t[$columns], v[6], d[3], b[3], u[3], e[6], variance, own, beyond = (real)0;
    int i, j, k;

    out->extrapolated = 0;
    phi[0] = (real)1;
    for (i = 0; i < MAGBRIDGE_PARAMETERS; i++)
        if (!(parameters[i] >= range[i][0] && parameters[i] <= range[i][1]))
            out->extrapolated = 1;
    for (i = 1; i < MONOMIALS; i++) {
        k = parent[i - 1][1];
        phi[i] = phi[parent[i - 1][0]] * ((parameters[k] - centre[k]) / scale[k]);
    }
    for (i = 0; i < $columns; i++)
        t[i] = (real)0;
    for (j = 0; j < PRODUCTS; j++) {
        const real psi = phi[pair[j][0]] * phi[pair[j][1]];
        for (i = 0; i < $columns; i++)
            t[i] += table[j][i] * psi;
    }

    for (i = 0; i < 3; i++)
        d[i] = field[i] - t[9 + i];
    for (i = 0; i < 3; i++)
        b[i] = t[3 * i] * d[0] + t[3 * i + 1] * d[1] + t[3 * i + 2] * d[2];
    out->total = ROOT(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]);

    /* V = Q.(d d') + L.d + O for each of its six entries; L and O as in magbridge's kernel.prepare */
    for (i = 0; i < 6; i++)
        e[i] = d[row[i]] * d[column[i]];
    for (k = 0; k < 6; k++) {
        const int r = row[k], c = column[k];
        real sum = (real)0, o = (real)0;
        for (i = 0; i < 6; i++)
            sum += t[12 + 6 * k + i] * e[i];
        for (i = 0; i < 3; i++) {
            real left = (real)0, right = (real)0;
            for (j = 0; j < 3; j++) {
                left += t[48 + 9 * r + 3 * i + j] * t[3 * c + j];
                right += t[48 + 9 * c + 3 * i + j] * t[3 * r + j];
            }
            sum -= (left + right) * d[i];
        }
        for (i = 0; i < 3; i++) {
            real part = (real)0;
            for (j = 0; j < 3; j++)
                part += t[75 + place[i][j]] * t[3 * c + j];
            o += t[3 * r + i] * part;
        }
        v[k] = sum + o;
    }
    for (i = 0; i < 3; i++)
        u[i] = b[i] / (out->total + (real)1e-30);
    variance = SIZE(u[0] * u[0] * v[0] + u[1] * u[1] * v[1] + u[2] * u[2] * v[2]
                    + (real)2 * (u[0] * u[1] * v[3] + u[0] * u[2] * v[4] + u[1] * u[2] * v[5]));
    /* conditions as in magbridge's Correction: in half ranges beyond the range, without the level's error */
    own = variance - $level > $noise ? variance - $level : $noise;
    for (i = 0; i < MAGBRIDGE_CONDITIONS; i++) {
        const real excess = SIZE(conditions[i] - condition[i][0]) / condition[i][1] - (real)1;
        if (excess > (real)0)
            beyond += own * excess * excess;
    }
    if (beyond > variance)
        out->extrapolated = 1;
    out->total_sigma = ROOT(variance + beyond);
    for (i = 0; i < 3; i++) {
        const int y = (i + 1) % 3, z = (i + 2) % 3;
        const real turned = b[z] * b[z] * omega[y][y] + b[y] * b[y] * omega[z][z]
                            - (real)2 * b[y] * b[z] * omega[y][z];
        out->field[i] = b[i];
        out->field_sigma[i] = ROOT(SIZE(v[i] + turned) + beyond);
    }
}
