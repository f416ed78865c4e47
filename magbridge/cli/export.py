"""Write a calibration for other programs: C for a microcontroller, an autopilot's compass parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from magbridge.cli.common import Folder, Whole, command, complain, file_to_write
from magbridge.cli.remarks import warnings_of
from magbridge.errors import DataError, WrongUse


@command("export cal.json --c DIR | --ardupilot F.param | --px4 F.params")
def export(
    calibration: Path,
    /,
    *,
    c: Annotated[Folder | None, Parameter(name="--c")] = None,
    ardupilot: Annotated[Path | None, Parameter(validator=file_to_write(".param", ".parm"))] = None,
    px4: Annotated[Path | None, Parameter(validator=file_to_write(".params"))] = None,
    number: Annotated[Whole, Parameter(validator=validators.Number(gte=0, lte=3))] = 0,
) -> None:
    """Write a calibration for other programs, and say what they cannot hold of it.

    Parameters
    ----------
    calibration
        The calibration (cal.json).
    c
        A folder for magbridge_calibration.h and .c: C99 without allocation, float or double.
    ardupilot
        A .param file: offsets, diagonals, off-diagonals and the motors' current of a compass.
    px4
        A parameter file of QGroundControl: the same for PX4.
    number
        Which of the autopilot's compasses, from 0.
    """
    if c is None and ardupilot is None and px4 is None:
        raise WrongUse("expected --c DIR, --ardupilot F.param or --px4 F.params")

    from magbridge.calibration import export_autopilot
    from magbridge.calibration.export_c import c_header, c_source
    from magbridge.calibration.file import load
    from magbridge.errors import CalibrationError
    from magbridge.files import atomic_path, new_folder

    known = load(calibration)
    for doubt in warnings_of(known, calibration):
        complain(doubt)
    texts: dict[Path, str] = {}
    if c is not None:
        try:
            header, source = c_header(known), c_source(known)
            texts |= {c / "magbridge_calibration.h": header, c / "magbridge_calibration.c": source}
        except CalibrationError as error:
            raise DataError(f"{calibration}: {error}") from error
    if ardupilot is not None or px4 is not None:
        compass = export_autopilot.compass_of(known)
        for lost in compass.lost:
            complain(f"{calibration}: the autopilot's model cannot hold {lost}")
        if ardupilot is not None:
            texts[ardupilot], warnings = export_autopilot.ardupilot(compass, number)
            for warning in warnings:
                complain(warning)
        if px4 is not None:
            texts[px4] = export_autopilot.px4(compass, number)
    for file, text in texts.items():
        with new_folder(file.parent), atomic_path(file) as path:
            path.write_text(text, encoding="utf-8")
        print(f"{file}: written")
