"""Write a calibration for other programs: C for a microcontroller, an autopilot's compass parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, validators

from magbridge.cli.common import Folder, Json, Whole, command, complain, file_to_write, print_result
from magbridge.cli.remarks import warnings_of
from magbridge.errors import DataError, WrongUse

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration


SEAGLIDER_COUNT_NT = 100.0
"""nT in a count of most of a Seaglider's compasses."""


@command("export cal.json --c DIR | --ardupilot F.param | --px4 F.params | --seaglider F.cal | --table F.csv")
def export(
    calibration: Path,
    /,
    *,
    c: Annotated[Folder | None, Parameter(name="--c")] = None,
    ardupilot: Annotated[Path | None, Parameter(validator=file_to_write(".param", ".parm"))] = None,
    px4: Annotated[Path | None, Parameter(validator=file_to_write(".params"))] = None,
    number: Annotated[Whole, Parameter(validator=validators.Number(gte=0, lte=3))] = 0,
    seaglider: Annotated[Path | None, Parameter(validator=file_to_write(".cal"))] = None,
    nt_per_count: Annotated[
        float, Parameter(validator=validators.Number(gt=0, lte=1e5))
    ] = SEAGLIDER_COUNT_NT,
    table: Annotated[Path | None, Parameter(validator=file_to_write(".csv"))] = None,
    parameter: str = "",
    dip: Annotated[float, Parameter(validator=validators.Number(gt=-90, lt=90))] = 60.0,
    json: Json = False,
) -> None:
    """Write a calibration for other programs, and say what they cannot hold of it.

    Parameters
    ----------
    calibration
        The calibration (cal.json).
    c
        A folder for magbridge_calibration.h and .c: C99 without allocation, float or double. A scalar
        magnetometer of the calibration is in magbridge_scalar.h and .c.
    ardupilot
        A .param file: offsets, diagonals, off-diagonals and the motors' current of a compass.
    px4
        A parameter file of QGroundControl: the same for PX4.
    number
        Which of the autopilot's compasses, from 0.
    seaglider
        The compass coefficients (tcm2mat.cal) of a Seaglider: one offset and one matrix, with the boresight.
    nt_per_count
        For --seaglider: nT in a count of its compass, 100 for most, 56 for type 4.
    table
        A table (.csv) of offset and matrix at positions of one mass, for loggers that can hold one.
    parameter
        For --table: the mass; by default the first parameter.
    dip
        For --seaglider: the inclination of the Earth's field in deg, on which the heading error depends.
    """
    if not any((c, ardupilot, px4, seaglider, table)):
        raise WrongUse(
            "expected --c DIR, --ardupilot F.param, --px4 F.params, --seaglider F.cal or --table F.csv"
        )

    from magbridge.calibration.export_seaglider import position_table
    from magbridge.calibration.file import load
    from magbridge.errors import CalibrationError
    from magbridge.files import atomic_path, new_folder

    known = load(calibration)
    for doubt in [*warnings_of(known, calibration), *_filter_lag(known, calibration)]:
        complain(doubt)
    texts: dict[Path, str] = {}
    try:
        if c is not None:
            texts |= _in_c(known, c)
        if seaglider is not None:
            texts[seaglider] = _seaglider(calibration, known, nt_per_count, dip)
        if table is not None:
            first = known.parameters[0].name if known.parameters else ""
            texts[table] = position_table(known, parameter or first)
    except CalibrationError as error:
        raise DataError(f"{calibration}: {error}") from error
    texts |= _autopilot(calibration, known, ardupilot, px4, number)
    for file, text in texts.items():
        with new_folder(file.parent), atomic_path(file) as path:
            path.write_text(text, encoding="utf-8")
    files = [str(file) for file in texts]
    print_result({"files": files}, "\n".join(f"{file}: written" for file in files), json)


def _autopilot(
    file: Path, known: Calibration, ardupilot: Path | None, px4: Path | None, number: int
) -> dict[Path, str]:
    """Return the autopilots' parameter files that are asked for; report what these cannot hold."""
    from magbridge.calibration import export_autopilot

    if ardupilot is None and px4 is None:
        return {}
    compass, texts = export_autopilot.compass_of(known), dict[Path, str]()
    for lost in compass.lost:
        complain(f"{file}: the autopilot's model cannot hold {lost}")
    if ardupilot is not None:
        texts[ardupilot], warnings = export_autopilot.ardupilot(compass, number)
        for warning in warnings:
            complain(warning)
    if px4 is not None:
        texts[px4] = export_autopilot.px4(compass, number)
    return texts


def _in_c(known: Calibration, folder: Path) -> dict[Path, str]:
    """Return the C files of a calibration, with those of its first scalar magnetometer."""
    from magbridge.calibration.export_c import c_header, c_source
    from magbridge.calibration.export_scalar import scalar_header, scalar_source

    texts = {
        folder / "magbridge_calibration.h": c_header(known),
        folder / "magbridge_calibration.c": c_source(known),
    }
    for sensor in known.sensors[:1]:
        texts[folder / "magbridge_scalar.h"] = scalar_header(sensor)
        texts[folder / "magbridge_scalar.c"] = scalar_source(sensor)
    return texts


def _filter_lag(known: Calibration, file: Path) -> list[str]:
    """Return a warning if the exported files lack the sensor's filter."""
    cutoff = known.sensor.filter_cutoff
    return [f"{file}: no export undoes the sensor's filter of {cutoff:g} Hz"] if cutoff else []


def _seaglider(file: Path, known: Calibration, nt_per_count: float, dip: float) -> str:
    """Return a Seaglider's coefficients; report on stderr what they cannot hold, and its cost in degrees."""
    from magbridge.calibration.export_seaglider import heading_cost, seaglider

    text = seaglider(known, nt_per_count)
    for cost in heading_cost(known, dip):
        names = ", ".join(one.name for one in known.parameters)
        what = f"{cost.name} alone" if cost.name else f"the field of {names}"
        complain(
            f"{file}: the file cannot hold {what}: heading error {cost.rms:.2f} deg RMS, up to "
            f"{cost.largest:.2f} deg, at the ends of the range (dip {dip:g} deg)"
        )
    for effect in known.effects:
        complain(f"{file}: the file cannot hold the effect {effect.kind} of {' '.join(effect.channels())}")
    complain(f"{file}: the file cannot hold uncertainties and flags")
    return text
