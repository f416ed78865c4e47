"""Share the application, common options and the printing of results among the commands."""

from __future__ import annotations

import datetime as dt
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
from cyclopts import App, Parameter, Token

import magbridge as mb
from magbridge.errors import CalibrationError, DataError, FormatError, OutOfRange, WrongUse
from magbridge.files import existing
from magbridge.logs import Options, suffixes
from magbridge.logs.registry import is_bag
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr


def _default(value: object) -> object:
    """Return the default as the help shows it; None where it is not shown."""
    return None if value is False or value in {(), ""} else value


app = App(
    name="magbridge",
    help="A magnetometer bridge for vehicles whose own iron moves.",
    version=mb.__version__,
    suppress_keyboard_interrupt=False,  # main() prints it
    help_format="plaintext",  # markdown takes a tenth of a second to load, and a list needs none
    help_epilogue="Exit codes: 0 done, 1 the data do not allow it, 2 wrong usage.",
    default_parameter=Parameter(negative=(), show_default=_default),
)

F = TypeVar("F", bound=Callable[..., None])


def command(usage: str) -> Callable[[F], F]:
    """Make a function a command; `usage` is its line of the help, its docstring the rest."""
    # in markdown, paragraphs are wrapped as wide as the terminal is
    return partial(app.command, usage=f"Usage: magbridge {usage}", help_format="markdown")


def file_to_write(*suffixes: str) -> Callable[[Any, Any], None]:
    """Return a validator for a file to write, which is checked before any work is done."""

    def check(_: Any, path: Any) -> None:
        if path is None:
            return
        if path.is_dir():
            raise ValueError("Expected a file, got a folder.")
        if not path.parent.is_dir():
            raise ValueError(f"The folder {path.parent} does not exist.")
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"The folder {path.parent} cannot be written to.")
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError(f"Its name must end in {' or '.join(suffixes)}.")

    return check


def folder_to_write(_: Any, path: Any) -> None:
    """Validate a folder to write to, before any work is done."""
    if path is None:
        return
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise ValueError("Expected a folder, got a file." if there == path else f"{there} is a file.")
    if not os.access(there, os.W_OK):
        raise ValueError(f"The folder {there} cannot be written to.")


def _whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """Read a whole number; cyclopts would round 1.5 to 2."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected a whole number, got {tokens[0].value}.") from None


def _day(_: Any, tokens: Sequence[Token]) -> dt.date:
    """Read a date; cyclopts would also take a time of day, which no log counts from."""
    try:
        return dt.date.fromisoformat(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected YYYY-MM-DD, got {tokens[0].value}.") from None


Day = Annotated[dt.date | None, Parameter(converter=_day)]


@Parameter(name="*")
@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading logs.

    Parameters
    ----------
    date
        The day (UTC, YYYY-MM-DD) of a log whose times count from the boot: the Earth's field is that day's.
    compass
        Which of several compasses to use: its number, from 0, or its device id. If not given: the one that
        the log declares as used.
    sensor_log
        The log of a sensor with its own logger, to be combined with the vehicle's logs; may be repeated. If
        not given: found by its columns.
    clock_offset
        Seconds to add to the times of a sensor's own log.
    strict
        Refuse a log of which anything would be dropped, instead of dropping, counting and naming it.
    column
        A column under our name, NAME="THEIRS [unit]", as mag_x="Bx [uT]"; may be repeated.
    columns
        A columns.toml that renames and scales columns and declares units and the heading reference.
    """

    date: Day = None
    compass: str | None = None
    sensor_log: tuple[Path, ...] = ()
    clock_offset: float = 0.0
    strict: bool = False
    column: tuple[str, ...] = ()
    columns: Path | None = None

    @property
    def options(self) -> Options:
        """Options of the same meaning for :mod:`magbridge.logs`."""
        boot = None if self.date is None else dt.datetime.combine(self.date, dt.time(), dt.UTC).timestamp()
        return Options(
            self.strict, boot, self.compass, self.sensor_log, self.clock_offset, self.column, self.columns
        )

    @property
    def without_sensor_logs(self) -> Options:
        """Options for a log that is read without the sensor's own logs."""
        return replace(self.options, sensor_log=(), clock_offset_s=0.0)


@Parameter(name="*")
@dataclass(frozen=True)
class ScalarOptions:
    """A scalar magnetometer on the same vehicle.

    Parameters
    ----------
    scalar
        The column of a scalar magnetometer, nT. calibrate adds its compensation to the file; survey makes the
        map of it, and fits lag, lever arm and heading error. The channels that disturb it are those of
        --parameter; auto, and in calibrate also no --parameter: all telemetry of the log.
    lag
        Time in s by which the scalar is behind the vector and the positions; auto estimates it.
    lever
        Position of the scalar sensor: m forward, starboard and down of the log's positions, as 1.5,0,-0.3. If
        not given, survey estimates forward and starboard, and calibrate takes 0.
    """

    scalar: str = ""
    lag: str = "auto"
    lever: str = ""

    def check(self, *, is_reference: bool = False) -> None:
        """WrongUse: lag or lever arm are not numbers, or an option needs --scalar."""
        if not self.scalar and (is_reference or self.lag != "auto" or self.lever):
            raise WrongUse("--reference scalar, --lag, --lever: expected --scalar COLUMN with them; add it")
        try:
            are_finite = isfinite(self.lag_s or 0.0), all(map(isfinite, self.lever_m or ()))
        except ValueError:
            are_finite = False, False
        if not all(are_finite):
            raise WrongUse(
                f"--lag {self.lag}, --lever {self.lever or '0,0,0'}: expected auto or a number of s, and "
                "three numbers of m, F,R,D such as 1.5,0,-0.3"
            )

    @property
    def lag_s(self) -> float | None:
        """Lag, s; None: to be estimated."""
        return None if self.lag == "auto" else float(self.lag)

    @property
    def lever_m(self) -> tuple[float, float, float] | None:
        """Forward, starboard and down, m; None if not given."""
        if not self.lever:
            return None
        forward, starboard, down = (float(part) for part in self.lever.split(","))
        return forward, starboard, down


AS_THEY_SAY = ReadingOptions()
"""Logs are read as they declare themselves."""
NO_SCALAR = ScalarOptions()
"""No scalar magnetometer."""
Output = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write())]
CalibrationOutput = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".json"))]
SavedCalibration = Annotated[Path | None, Parameter(validator=file_to_write(".json"))]
Log = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(*suffixes(write=True)))]
Folder = Annotated[Path, Parameter(validator=folder_to_write)]
Grid = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".nc"))]
Base = Annotated[Path | None, Parameter(name=["--base-station", "--base"])]
Heading = Annotated[
    Literal["true", "magnetic"] | None,
    Parameter(help="What headings refer to. If not given: what the log says, else true north."),
]
Plot = Annotated[Path | None, Parameter(validator=file_to_write(".png", ".pdf", ".svg"))]
Whole = Annotated[int, Parameter(converter=_whole_number)]
Json = Annotated[bool, Parameter(help="Print the result, or the error, as one JSON object.")]


def check_inputs(
    files: tuple[Path, ...], output: Path | None = None, *others: Path | None
) -> tuple[Path, ...]:
    """Return `files`; WrongUse: there is none, or `output` is one of them or of `others`."""
    if not files:
        raise WrongUse("expected at least one FILE")
    read = [os.path.realpath(path) for path in (*files, *others) if path is not None]
    if output is not None and os.path.realpath(output) in read:
        raise WrongUse(f"{output}: is one of the files to read; choose another file to write")
    return files


def logs_to_read(files: tuple[Path, ...], output: Path | None = None, *others: Path | None) -> None:
    """Check, before anything heavy is imported, that logs are there and are not written over.

    `others` are other files to read; one of them may be a folder, as a grid is.

    WrongUse: as :func:`check_inputs`. FormatError: one is not there, or a log is empty.
    """
    for path in check_inputs(files, output, *others):
        if not is_bag(path) and not existing(path).stat().st_size:
            raise FormatError(path, "expected a log, got an empty file")
    for other in others:
        if other is not None and not other.is_dir():
            existing(other)


def without_dask() -> None:
    """Import xarray without dask: a log has no dask arrays, and importing them takes 0.4 s.

    xarray looks for dask when it is imported and with its first array, and keeps the result.
    """
    if {"xarray", "dask"} & sys.modules.keys():
        return
    sys.modules["dask"] = None  # type: ignore[assignment]  # Python then refuses to import it
    import xarray as xr

    xr.Dataset({"a": ("x", [0.0])}).load()
    del sys.modules["dask"]


class FailedResult(DataError):
    """An error that the result, which is already printed, describes: JSON output has no second object."""

    def __init__(self, sentence: str, exit_code: int = 1) -> None:
        self.exit_code = exit_code
        super().__init__(sentence)


def print_result(result: Mapping[str, Any], sentence: str, as_json: bool) -> None:
    """Print the result, for people or for machines."""
    from magbridge.arrays import plain

    if as_json:
        print(msgspec.json.encode(result, enc_hook=plain).decode())
    elif sentence:
        print(sentence)


def print_error(sentence: str, code: int) -> None:
    """Print the JSON object of a command that has no result: its error message and its exit code."""
    print(msgspec.json.encode({"error": " ".join(sentence.split()), "exit_code": code}).decode())


def complain(sentence: str, code: int = 0) -> int:
    """Print one line to stderr; return `code`, the exit code that goes with it."""
    print("magbridge:", " ".join(sentence.split()), file=sys.stderr)
    return code


MAX_NAMED_LOSSES = 5
"""Losses that are named, a line each; the others are counted."""


@contextmanager
def naming(deployment: xr.Dataset) -> Iterator[None]:
    """Raise errors of the block as :class:`DataError` whose message begins with the names of the logs."""
    try:
        yield
    except (CalibrationError, OutOfRange) as error:
        raise DataError(f"{deployment.attrs['source']}: {error}") from error


def warnings_of(calibration: mb.Calibration, file: Path) -> list[str]:
    """Return a line with the reasons why the data do not support a calibration; empty if they do."""
    warnings = "; ".join(calibration.warnings)
    return [f"{file}: the data it was fitted to do not support it: {warnings}"] if warnings else []


def read_log(
    files: Path | Sequence[Path],
    reading: ReadingOptions,
    heading_reference: str | None = None,
    required: Sequence[str] = (),
) -> xr.Dataset:
    """Return logs as one, with headings from true north; report on stderr what reading skipped."""
    from magbridge.field.reference import with_true_heading

    with waiting("reading"):
        log = mb.read(files, required=required, options=reading.options)
    note_losses(log.attrs)
    return with_true_heading(log, heading_reference)


def note_losses(*pieces: Mapping[str, Any]) -> None:
    """Report on stderr what reading skipped, from the attributes of a deployment or of its pieces."""
    from magbridge.logs.deployment import COUNTERS, GUESSED_ATTRIBUTE, named_losses, noted, passed_over

    for guess in dict.fromkeys(str(attrs.get(GUESSED_ATTRIBUTE, "")) for attrs in pieces):
        if guess:
            complain(f"guessed: {guess}")
    if counts := passed_over(*pieces):
        losses = ", ".join(f"{count} {COUNTERS[name][count > 1]}" for name, count in counts.items())
        complain(f"in the logs: {losses}")
    for note in dict.fromkeys(noted(*pieces)):
        complain(note)
    lines = named_losses(*pieces)
    for line in lines[:MAX_NAMED_LOSSES]:
        complain(line)
    if len(lines) > MAX_NAMED_LOSSES:
        complain(f"and in {counted(len(lines) - MAX_NAMED_LOSSES, 'place')} more")


def by_base_station(logs: Sequence[xr.Dataset], base: Path | None) -> list[xr.Dataset]:
    """Return a vehicle's logs with what the field varied by.

    That is by a file of its own, or by an observatory's log among the others.

    FormatError, DataError: the base station's log has no field, or not for the logs' time.
    """
    from magbridge.field.reference import separate_observatories, with_daily_variation
    from magbridge.logs.deployment import join

    own, stations = separate_observatories(logs)
    if base is not None:
        stations = [mb.read(base)]
    if not own or not stations:
        return list(logs)
    if len({station.attrs.get("observatory") for station in stations}) > 1:
        names = " and ".join(str(station.attrs["source"]) for station in stations)
        raise WrongUse(f"{names}: expected logs of one observatory, got several; give that of the nearest")
    station = join(stations)
    note_losses(station.attrs)
    return with_daily_variation(own, station)


def chosen_parameters(named: Sequence[str], deployment: xr.Dataset, **options: Any) -> tuple[str, ...]:
    """Return the parameters of a fit: those that are named, or for ``auto`` the columns that are worth it.

    ``auto`` tries positions, currents, temperatures and pressures.
    The improvement by each column on held-out parts is printed to stderr. `options` are of
    :func:`~magbridge.calibration.fitting.parameter_choice.best_parameters`.

    WrongUse: ``auto`` among names.
    """
    from magbridge.calibration.fitting.parameter_choice import AUTO, best_parameters, lines
    from magbridge.logs.info import conditions, movers

    if AUTO not in named:
        return tuple(named)
    if len(named) > 1:
        raise WrongUse(
            f"--parameter {AUTO}: expected no other --parameter, because {AUTO} chooses among all columns"
        )
    offered = [*movers(deployment), *conditions(deployment)]
    taken, offers = best_parameters(deployment, offered, **options)
    for line in lines(offers) or [
        f"--parameter {AUTO}: none of {' '.join(offered) or 'its columns'} moves the field"
    ]:
        complain(line)
    return taken


def note_missing(calibration: mb.Calibration, deployment: xr.Dataset) -> None:
    """Warn on stderr of columns that the calibration needs and a log does not have."""
    for name in calibration.channels:
        if name not in deployment:
            lacking = f"{deployment.attrs['source']}: no column {name!r}, which the calibration needs"
            remedy = f"name the log's own column with --column {name}=THEIRS"
            complain(f"{lacking}: every sample is flagged, with a wider sigma; {remedy}")


def note_unused_grid(grid: Path | None, *logs: xr.Dataset) -> None:
    """Warn on stderr of logs that hold a reference in every row: a grid is only added to the IGRF."""
    for log in logs if grid else ():
        if "reference_field" in log and log["reference_field"].notnull().all():
            complain(f"{log.attrs['source']}: has reference_field in every row, so --grid {grid} is not used")


def note_no_date(deployment: xr.Dataset) -> None:
    """Warn on stderr that a log has no anomaly, since the field of its day is not known."""
    from magbridge.columns import counts_from_boot

    if counts_from_boot(deployment):
        source = deployment.attrs["source"]
        complain(f"{source}: its times count from the boot, so no anomaly is written; give --date YYYY-MM-DD")


def note_settings(*pieces: Mapping[str, Any]) -> None:
    """Warn on stderr where a bridge was tuned in the course of its log, from the attributes of its pieces."""
    from magbridge.logs.deployment import CHANGES_SETTING

    for attrs in pieces:
        if times := int(attrs.get(CHANGES_SETTING, 0)):
            often = "once" if times == 1 else f"{times} times"
            complain(
                f"{attrs['source']}: MB_* parameters were set {often} in the course of the log; it is "
                "corrected with those of its start (magbridge replay follows them)"
            )
            return


def refuse_unsuited(calibration: mb.Calibration, deployment: xr.Dataset) -> None:
    """FormatError: a log to be corrected is of another sensor, or parameters or channels in another unit."""
    from magbridge.columns import CHANNELS, require_units
    from magbridge.field.reference import other_units

    source, sensor = deployment.attrs["source"], str(deployment.attrs.get("sensor", ""))
    if not calibration.sensor.may_be(sensor):
        raise FormatError(
            source, f"expected a log of sensor {calibration.sensor.name!r}, the calibration's, got {sensor!r}"
        )
    require_units(deployment, calibration.units)
    channels = deployment[list(CHANNELS)].to_array().to_numpy().T
    if wrong := other_units(channels, calibration.reference.field):
        raise FormatError(source, wrong)
