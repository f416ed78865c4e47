"""Export a calibration as C99 for a microcontroller: one header and one source, without allocation.

The source is the table of :class:`~magbridge.calibration.kernel.Kernel` and the arithmetic of that module,
in the same order: in double it gives the field to the last bits that the sum's order keeps (1e-8 nT), in
float to some 0.02 nT of 50,000.
"""

from __future__ import annotations

from collections.abc import Sequence
from string import Template

from magbridge.calibration.file import calibration_id
from magbridge.calibration.kernel import TABLE_SUMS
from magbridge.calibration.model import Calibration
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS

__all__ = ["c_header", "c_source", "hexadecimal", "reals", "rows"]

C_HEADER = Template("""/* Made by magbridge export from calibration $id: do not edit.
 *
 * Compile with -DMAGBRIDGE_FLOAT for float; otherwise double. No allocation, no state, no other library than
 * sqrt() of the mathematical one.
 */
#ifndef MAGBRIDGE_CALIBRATION_H
#define MAGBRIDGE_CALIBRATION_H

#ifdef MAGBRIDGE_FLOAT
typedef float magbridge_real;
#else
typedef double magbridge_real;
#endif

#define MAGBRIDGE_CALIBRATION_ID 0x${id}u
#define MAGBRIDGE_PARAMETERS $count
$names
/* the corrected field, nT; body axes, or the sensor's where MAGBRIDGE_BORESIGHT is 0 */
#define MAGBRIDGE_BORESIGHT $boresight
typedef struct {
    magbridge_real total, total_sigma;
    magbridge_real field[3], field_sigma[3];
    int extrapolated; /* a parameter is outside the range that was calibrated */
} magbridge_corrected;

/* field: as read, nT, sensor axes; parameters: in the order and the units above. NaN gives NaN. */
void magbridge_correct(const magbridge_real field[3], const magbridge_real *parameters,
                       magbridge_corrected *out);

#endif
""")

SOURCE = Template("""/* Made by magbridge export from calibration $id: do not edit. */
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
                       magbridge_corrected *out)
{
    real phi[MONOMIALS], t[$columns], v[6], d[3], b[3], u[3], e[6];
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
    out->total_sigma = ROOT(SIZE(u[0] * u[0] * v[0] + u[1] * u[1] * v[1] + u[2] * u[2] * v[2]
                                 + (real)2 * (u[0] * u[1] * v[3] + u[0] * u[2] * v[4] + u[1] * u[2] * v[5])));
    for (i = 0; i < 3; i++) {
        const int y = (i + 1) % 3, z = (i + 2) % 3;
        const real turned = b[z] * b[z] * omega[y][y] + b[y] * b[y] * omega[z][z]
                            - (real)2 * b[y] * b[z] * omega[y][z];
        out->field[i] = b[i];
        out->field_sigma[i] = ROOT(SIZE(v[i] + turned));
    }
}
""")


def c_header(calibration: Calibration) -> str:
    """Return ``magbridge_calibration.h``."""
    lines = []
    for k, one in enumerate(calibration.parameters):
        listed = f"{k}: {one.name} [{one.unit or '1'}], from {one.low!r} to {one.high!r}"
        lines.append(f"/* parameter {listed.replace('*/', '')} */")
    return C_HEADER.substitute(
        id=f"{calibration_id(calibration):08x}",
        count=len(calibration.parameters),
        names="\n".join(lines),
        boresight=int(calibration.boresight is not None),
    )


def c_source(calibration: Calibration) -> str:
    """Return ``magbridge_calibration.c``.

    CalibrationError: it has effects, which follow telemetry in time: they have a state, and are not written.
    """
    if calibration.effects:
        names = ", ".join(sorted({type(one).__name__ for one in calibration.effects}))
        raise CalibrationError(f"{names}: effects that follow telemetry in time are not written as C")
    # the tables of the compiled kernel, so that C and Python do the same sums in the same order
    kernel = calibration.kernel
    omega = calibration.boresight.covariance if calibration.boresight else ((0.0,) * 3,) * 3
    place = [[0] * 3 for _ in range(3)]
    # place of entry (i, j) among the six of a symmetric matrix
    for k, (i, j) in enumerate(PAIRS):
        place[i][j] = place[j][i] = k
    # C has no empty arrays: one row of zeros where there is no parameter
    some = calibration.parameters or ()
    tables = [
        reals("centre[]", kernel.centre or (0.0,)),
        reals("scale[]", kernel.scale or (1.0,)),
        rows(
            "real",
            "range[][2]",
            [[hexadecimal(one.low), hexadecimal(one.high)] for one in some] or [["0", "0"]],
        ),
        rows("int", "parent[][2]", [[str(n) for n in one] for one in kernel.parents] or [["0", "0"]]),
        rows("int", "pair[][2]", [[str(i), str(j)] for i, j in kernel.pairs]),
        rows("int", "place[3][3]", [[str(n) for n in one] for one in place]),
        rows("real", "omega[3][3]", [[hexadecimal(float(n)) for n in one] for one in omega]),
        f"static const int row[6] = {{{', '.join(str(i) for i, _ in PAIRS)}}};",
        f"static const int column[6] = {{{', '.join(str(j) for _, j in PAIRS)}}};",
        rows(
            "real",
            f"table[PRODUCTS][{TABLE_SUMS}]",
            [[hexadecimal(float(n)) for n in one] for one in kernel.table.T],
        ),
    ]
    return SOURCE.substitute(
        id=f"{calibration_id(calibration):08x}",
        monomials=len(kernel.parents) + 1,
        products=len(kernel.pairs),
        columns=TABLE_SUMS,
        tables="\n".join(tables),
    )


def hexadecimal(number: float) -> str:
    """Return a C99 constant that is the number to the last bit."""
    return f"(real){number.hex()}"


def reals(name: str, numbers: Sequence[float]) -> str:
    """Return the C constant `name`, an array of the numbers."""
    return f"static const real {name} = {{{', '.join(map(hexadecimal, numbers))}}};"


def rows(kind: str, name: str, table: Sequence[Sequence[str]]) -> str:
    """Return the C constant `name`, a table of numbers of a `kind`, which are written already."""
    lines = ",\n".join(f"    {{{', '.join(row)}}}" for row in table)
    return f"static const {kind} {name} = {{\n{lines}\n}};"
