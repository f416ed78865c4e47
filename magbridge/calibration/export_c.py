"""Export a calibration as C99 for a microcontroller: one header and one source, without allocation.

The source holds the table of :class:`~magbridge.calibration.kernel.Kernel` and repeats its arithmetic in the
same order. In double its field differs from that of Python by 1e-8 nT, in float by about 0.02 nT. The
templates of both files are in ``c_templates``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from string import Template

from magbridge.calibration.file import calibration_id
from magbridge.calibration.kernel import TABLE_SUMS
from magbridge.calibration.model import Calibration
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS


def c_header(calibration: Calibration) -> str:
    """Return the text of ``magbridge_calibration.h``."""
    lines = []
    for k, one in enumerate(calibration.parameters):
        listed = f"{k}: {one.name} [{one.unit or '1'}], from {one.low!r} to {one.high!r}"
        lines.append(f"/* parameter {listed.replace('*/', '')} */")
    return c_template("magbridge_calibration.h").substitute(
        id=f"{calibration_id(calibration):08x}",
        count=len(calibration.parameters),
        names="\n".join(lines),
        boresight=int(calibration.boresight is not None),
    )


def c_source(calibration: Calibration) -> str:
    """Return the text of ``magbridge_calibration.c``.

    CalibrationError: the calibration has effects, whose state the C code does not support.
    """
    if calibration.effects:
        names = ", ".join(sorted({type(one).__name__ for one in calibration.effects}))
        raise CalibrationError(f"{names}: effects that follow telemetry in time are not written as C")
    # the tables of the compiled kernel, so that C and Python do the same sums in the same order
    kernel = calibration.kernel
    omega = calibration.boresight.covariance if calibration.boresight else ((0.0,) * 3,) * 3
    place = [[0] * 3 for _ in range(3)]
    # index of entry (i, j) among the six entries of a symmetric matrix
    for k, (i, j) in enumerate(PAIRS):
        place[i][j] = place[j][i] = k
    # C has no empty arrays: without parameters, write one row of zeros
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
    return c_template("magbridge_calibration.c").substitute(
        id=f"{calibration_id(calibration):08x}",
        monomials=len(kernel.parents) + 1,
        products=len(kernel.pairs),
        columns=TABLE_SUMS,
        tables="\n".join(tables),
    )


def c_template(name: str) -> Template:
    """Return the template of the C file `name`, with placeholders for a calibration's tables."""
    return Template(files("magbridge.calibration").joinpath("c_templates", name).read_text("utf-8"))


def hexadecimal(number: float) -> str:
    """Return a C99 hexadecimal constant that equals the number to the last bit."""
    return f"(real){number.hex()}"


def reals(name: str, numbers: Sequence[float]) -> str:
    """Return the C definition of the constant array `name` with the numbers as elements."""
    return f"static const real {name} = {{{', '.join(map(hexadecimal, numbers))}}};"


def rows(kind: str, name: str, table: Sequence[Sequence[str]]) -> str:
    """Return the C definition of the constant table `name`, with elements of the C type `kind`.

    `table`: the elements, row by row, as C text.
    """
    lines = ",\n".join(f"    {{{', '.join(row)}}}" for row in table)
    return f"static const {kind} {name} = {{\n{lines}\n}};"
