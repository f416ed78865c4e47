"""Export a calibration as C99 for a microcontroller: one header and one source, without allocation.

The source holds the table of :class:`~magbridge.calibration.kernel.Kernel` and repeats its arithmetic in the
same order. In double its field differs from that of Python by 1e-8 nT, in float by about 0.02 nT. The
templates of both files are in ``c_templates``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from string import Template

import numpy as np

from magbridge.calibration.correct import valid_ranges
from magbridge.calibration.file import calibration_id
from magbridge.calibration.kernel import TABLE_SUMS
from magbridge.calibration.model import SLOT, CalibratedRange, Calibration, Parameter
from magbridge.calibration.scalar import ScalarChannel
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS


def c_header(calibration: Calibration) -> str:
    """Return the text of ``magbridge_calibration.h``."""
    return c_template("magbridge_calibration.h").substitute(
        id=f"{calibration_id(calibration):08x}",
        count=len(calibration.parameters),
        names=inputs("parameter", calibration.parameters),
        conditions=len(calibration.unmodelled_conditions),
        condition_names=inputs("condition", calibration.unmodelled_conditions),
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
    # C has no empty arrays: without inputs, write one row
    conditions = [one.middle_and_half for one in calibration.unmodelled_conditions]
    tables = [
        reals("centre[]", kernel.centre or (0.0,)),
        reals("scale[]", kernel.scale or (1.0,)),
        rows("range[][2]", valid_ranges(calibration) or [[0.0, 0.0]]),
        rows("condition[][2]", conditions or [[0.0, 1.0]]),
        rows("parent[][2]", kernel.parents or [(0, 0)]),
        rows("pair[][2]", kernel.pairs),
        rows("place[3][3]", SLOT),
        rows("omega[3][3]", np.asarray(omega, float).tolist()),
        f"static const int row[6] = {{{', '.join(str(i) for i, _ in PAIRS)}}};",
        f"static const int column[6] = {{{', '.join(str(j) for _, j in PAIRS)}}};",
        rows(f"table[PRODUCTS][{TABLE_SUMS}]", kernel.table.T.tolist()),
    ]
    return c_template("magbridge_calibration.c").substitute(
        id=f"{calibration_id(calibration):08x}",
        monomials=len(kernel.parents) + 1,
        products=len(kernel.pairs),
        columns=TABLE_SUMS,
        noise=hexadecimal(calibration.noise.sensor**2),
        level=hexadecimal(calibration.reference.level_sigma**2),
        tables="\n".join(tables),
    )


def c_template(name: str) -> Template:
    """Return the template of the C file `name`, with placeholders for a calibration's tables."""
    return Template(files("magbridge.calibration").joinpath("c_templates", name).read_text("utf-8"))


def inputs(kind: str, channels: Sequence[Parameter | ScalarChannel | CalibratedRange]) -> str:
    """Return a C comment for each input: its number, name, unit and calibrated range."""
    return "\n".join(
        f"/* {kind} {k}: {one.name} [{one.unit or '1'}], from {one.low!r} to {one.high!r}".replace("*/", "")
        + " */"
        for k, one in enumerate(channels)
    )


def hexadecimal(number: float) -> str:
    """Return a C99 hexadecimal constant that equals the number to the last bit."""
    return f"(real){number.hex()}"


def reals(name: str, numbers: Sequence[float]) -> str:
    """Return the C definition of the constant array `name` with the numbers as elements."""
    return f"static const real {name} = {{{', '.join(map(hexadecimal, numbers))}}};"


def rows(name: str, table: Sequence[Sequence[float]]) -> str:
    """Return the C definition of the constant table `name`; of type ``int`` if all elements are integers."""
    whole = all(isinstance(one, int) for row in table for one in row)
    texts = [", ".join(str(one) if whole else hexadecimal(one) for one in row) for row in table]
    lines = ",\n".join(f"    {{{text}}}" for text in texts)
    return f"static const {'int' if whole else 'real'} {name} = {{\n{lines}\n}};"
