"""Define the application, and the options, checks and messages that several commands use."""

from __future__ import annotations

import datetime as dt
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
from cyclopts import App, Parameter, Token, validators

import magbridge as mb
from magbridge.calibration.fitting import FIT_RANGES
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError, DataError, FormatError, OutOfRange, WrongUse
from magbridge.files import existing
from magbridge.logs import Options, suffixes
from magbridge.logs.registry import is_bag
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr


def _default(value: object) -> object:
    """Return the default value for the help; None if the help is not to show it."""
    return None if value is False or value in {(), ""} else value


app = App(
    name="magbridge",
    help="A magnetometer bridge for vehicles whose own iron moves.",
    version=mb.__version__,
    suppress_keyboard_interrupt=False,  # main() reports the interrupt
    help_format="plaintext",  # loading markdown takes 0.1 s, and the list of commands does not need it
    help_epilogue="Exit codes: 0 done, 1 the data do not allow it, 2 wrong usage.",
    default_parameter=Parameter(negative=(), show_default=_default),
)

F = TypeVar("F", bound=Callable[..., None])


def command(usage: str) -> Callable[[F], F]:
    """Return a decorator that makes a function a command with the given usage line in its help."""
    # markdown paragraphs are wrapped at the width of the terminal
    return partial(app.command, usage=f"Usage: magbridge {usage}", help_format="markdown")


def file_to_write(*suffixes: str) -> Callable[[Any, Any], None]:
    """Return a validator of a file to write: its folder is writable, and its suffix is one of `suffixes`."""

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
    """Check that a folder to write to can be created or written; ValueError: it cannot."""
    if path is None:
        return
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise ValueError("Expected a folder, got a file." if there == path else f"{there} is a file.")
    if not os.access(there, os.W_OK):
        raise ValueError(f"The folder {there} cannot be written to.")


def _whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """Convert a word to an integer, without rounding 1.5 to 2 as cyclopts does."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected a whole number, got {tokens[0].value}.") from None


def _day(_: Any, tokens: Sequence[Token]) -> dt.date:
    """Convert a word to a date; in contrast to cyclopts, reject a time of day."""
    try:
        return dt.date.fromisoformat(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected YYYY-MM-DD, got {tokens[0].value}.") from None


Day = Annotated[dt.date | None, Parameter(converter=_day)]
Whole = Annotated[int, Parameter(converter=_whole_number)]


@Parameter(name="*")
@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading logs.

    Parameters
    ----------
    date
        The day (UTC, YYYY-MM-DD) of a log whose times count from the boot; it dates the Earth's field.
    compass
        Number, from 0, or device id of the compass to use. By default the compass that the log declares as
        used.
    sensor_log
        The log of a sensor with its own logger, to combine with the vehicle's logs; may be repeated. If not
        given, the command identifies sensor logs among the files by their columns.
    clock_offset
        Seconds to add to the times of a sensor's own log.
    strict
        Reject a log with unusable content, instead of skipping, counting and reporting the content.
    column
        A column NAME of magbridge and the log's own name of it, NAME="THEIRS [unit]", such as
        mag_x="Bx [uT]"; may be repeated.
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
        """These options as an object of :mod:`magbridge.logs`."""
        boot = None if self.date is None else dt.datetime.combine(self.date, dt.time(), dt.UTC).timestamp()
        sensor = self.sensor_log, self.clock_offset
        return Options(self.strict, boot, self.compass, *sensor, self.column, self.columns)

    @property
    def without_sensor_logs(self) -> Options:
        """These options without ``--sensor-log`` and ``--clock-offset``."""
        return replace(self.options, sensor_log=(), clock_offset_s=0.0)


@Parameter(name="*")
@dataclass(frozen=True)
class ScalarOptions:
    """Options for a scalar magnetometer on the same vehicle.

    Parameters
    ----------
    scalar
        The column of a scalar magnetometer, nT. calibrate adds its compensation to the calibration file;
        survey maps it, and fits its lag, lever arm and heading error. The channels of --parameter are the
        channels that disturb it. All telemetry of the log does with --parameter auto, and in calibrate also
        without --parameter.
    lag
        Delay in s of the scalar relative to the vector and the positions; auto estimates it.
    lever
        Position of the scalar sensor in m forward, starboard and down of the log's positions, such as
        1.5,0,-0.3. If not given, survey estimates forward and starboard, and calibrate uses 0,0,0.
    """

    scalar: str = ""
    lag: str = "auto"
    lever: str = ""

    def check(self, *, is_reference: bool = False) -> None:
        """Check the options; WrongUse: lag or lever arm are not numbers, or an option needs --scalar."""
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
        """Lag of the scalar, s; None if it is to be estimated."""
        return None if self.lag == "auto" else float(self.lag)

    @property
    def lever_m(self) -> tuple[float, float, float] | None:
        """Lever arm forward, starboard and down, m; None if not given."""
        if not self.lever:
            return None
        forward, starboard, down = (float(part) for part in self.lever.split(","))
        return forward, starboard, down


def fit_range(option: str) -> validators.Number:
    """Return a validator of an option of the fit."""
    low, high = FIT_RANGES[option]
    return validators.Number(gte=low, lte=high)


@Parameter(name="*")
@dataclass(frozen=True)
class FitOptions:
    """Options for the fit of a calibration.

    Parameters
    ----------
    parameter
        A column with the position of a moving mass, or a current; may be repeated. auto: the columns of the
        log that improve the prediction of held-out parts.
    order
        Highest total degree of the polynomials in the parameters.
    position_sigma
        1-sigma in m of the slow drift of dead-reckoned positions, if the crustal field is estimated; 0:
        positions are exact.
    base
        A base station's log (total_field, or a vector), whose variation is subtracted. A log of an
        observatory (IAGA-2002) among the logs is used in the same way.
    """

    parameter: tuple[str, ...] = ()
    order: Annotated[Whole, Parameter(validator=fit_range("order"))] = 3
    position_sigma: Annotated[float, Parameter(validator=fit_range("position_sigma"))] = 0.0
    base: Annotated[Path | None, Parameter(name=["--base-station", "--base"])] = None

    @property
    def named(self) -> tuple[str, ...]:
        """Names of the given parameters, without ``auto``."""
        return tuple(name for name in self.parameter if name != "auto")

    @property
    def drift(self) -> dict[str, Any]:
        """Option ``position_sigma`` of the fit if positions drift; else empty."""
        return {"position_sigma": self.position_sigma} if self.position_sigma else {}


NO_PARAMETERS = FitOptions()
"""Default: a fit without parameters."""
AS_THEY_SAY = ReadingOptions()
"""Default: logs are read as their own headers declare."""
NO_SCALAR = ScalarOptions()
"""Default: the logs are not used for a scalar magnetometer."""
Output = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write())]
CalibrationOutput = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".json"))]
SavedCalibration = Annotated[Path | None, Parameter(validator=file_to_write(".json"))]
Log = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(*suffixes(write=True)))]
Folder = Annotated[Path, Parameter(validator=folder_to_write)]
FolderOutput = Annotated[Folder, Parameter(name=["--output", "-o"])]
Grid = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".nc"))]
Heading = Annotated[
    Literal["true", "magnetic", "inertial"] | None,
    Parameter(
        help="What headings refer to; inertial: true north, by an instrument other than the magnetometer, so "
        "that a fit may use them. If not given: what the log says, else true north."
    ),
]
Plot = Annotated[Path | None, Parameter(validator=file_to_write(".png", ".pdf", ".svg"))]
Json = Annotated[bool, Parameter(help="Print the result, or the error, as one JSON object.")]


def check_inputs(files: tuple[Path, ...], output: Path | None = None, *others: Path | None) -> None:
    """Check the paths of a command; WrongUse: `files` is empty, or `output` is one of `files` or `others`."""
    if not files:
        raise WrongUse("expected at least one FILE")
    read = [os.path.realpath(path) for path in (*files, *others) if path is not None]
    if output is not None and os.path.realpath(output) in read:
        raise WrongUse(f"{output}: is one of the files to read; choose another file to write")


def logs_to_read(files: tuple[Path, ...], output: Path | None = None, *others: Path | None) -> None:
    """Check that the logs exist and that `output` does not overwrite them, before slow imports.

    `others` are other files or folders to read, such as grids.

    WrongUse: as :func:`check_inputs`. FormatError: a file does not exist, or a log is empty.
    """
    check_inputs(files, output, *others)
    for path in files:
        if not is_bag(path) and not existing(path).stat().st_size:
            raise FormatError(path, "expected a log, got an empty file")
    for other in others:
        if other is not None and not other.is_dir():
            existing(other)


def without_dask() -> None:
    """Import xarray without dask, because logs do not use dask arrays and importing dask takes 0.4 s.

    xarray looks for dask at its own import and with its first array, and remembers the result.
    """
    if {"xarray", "dask"} & sys.modules.keys():
        return
    sys.modules["dask"] = None  # type: ignore[assignment]  # Python then refuses to import it
    import xarray as xr

    xr.Dataset({"a": ("x", [0.0])}).load()
    del sys.modules["dask"]


class FailedResult(DataError):
    """Error that the printed result already describes, so that no second JSON object is printed."""

    def __init__(self, sentence: str, exit_code: int = 1) -> None:
        self.exit_code = exit_code
        super().__init__(sentence)


def print_result(result: Mapping[str, Any], sentence: str, as_json: bool, file: Path | None = None) -> None:
    """Print the result, with the written `file` if given: as JSON if `as_json`, else the text `sentence`."""
    from magbridge.arrays import plain

    if file is not None:
        result, sentence = {"file": str(file), **result}, f"{file}: {sentence}"
    if as_json:
        print(msgspec.json.encode(result, enc_hook=plain).decode())
    elif sentence:
        print(sentence)


def complain(sentence: str, code: int = 0) -> int:
    """Print a message as one line to stderr, and return the exit code `code`."""
    print("magbridge:", " ".join(sentence.split()), file=sys.stderr)
    return code


def complain_all(messages: Iterable[str | Diagnostic]) -> None:
    """Print messages to stderr, one line each."""
    for message in messages:
        complain(message if isinstance(message, str) else message.text)


MAX_NAMED_LOSSES = 5
"""Largest number of skipped parts of a log that are reported one by one; the others are counted."""


@contextmanager
def naming(source: xr.Dataset | Path) -> Iterator[None]:
    """Convert calibration and range errors in the block to a :class:`DataError` that names the source."""
    try:
        yield
    except (CalibrationError, OutOfRange) as error:
        name = source if isinstance(source, Path) else source.attrs["source"]
        raise DataError(f"{name}: {error}") from error


def warnings_of(calibration: mb.Calibration, file: Path) -> list[str]:
    """Return a list with the warning that a calibration is not supported by its data; empty if it is."""
    warnings = "; ".join(calibration.warnings)
    return [f"{file}: the data it was fitted to do not support it: {warnings}"] if warnings else []


def read_log(
    files: Path | Sequence[Path],
    reading: ReadingOptions,
    heading_reference: str | None = None,
    required: Sequence[str] = (),
) -> xr.Dataset:
    """Read logs as one deployment with headings from true north, and report skipped content on stderr."""
    from magbridge.field.reference import with_true_heading

    with waiting("reading"):
        log = mb.read(files, required=required, options=reading.options)
    note_losses(log.attrs)
    return with_true_heading(log, heading_reference)


def note_losses(*pieces: Mapping[str, Any]) -> None:
    """Report skipped content of logs on stderr, from the attributes of a deployment or of its pieces."""
    from magbridge.logs.deployment import COUNTERS, GUESSED_ATTRIBUTE, named_losses, noted, passed_over

    guesses = dict.fromkeys(str(attrs.get(GUESSED_ATTRIBUTE, "")) for attrs in pieces)
    complain_all(f"guessed: {guess}" for guess in guesses if guess)
    if counts := passed_over(*pieces):
        losses = ", ".join(f"{count} {COUNTERS[name][count > 1]}" for name, count in counts.items())
        complain(f"in the logs: {losses}")
    lines = named_losses(*pieces)
    complain_all([*dict.fromkeys(noted(*pieces)), *lines[:MAX_NAMED_LOSSES]])
    if len(lines) > MAX_NAMED_LOSSES:
        complain(f"and in {counted(len(lines) - MAX_NAMED_LOSSES, 'place')} more")


def read_apart(
    files: Sequence[Path], reading: ReadingOptions
) -> tuple[dict[Path, xr.Dataset], list[xr.Dataset], dict[Path, DataError]]:
    """Return each log of `files` and `reading`, the logs with sensor logs combined, and the errors."""
    from magbridge.logs.access import read_apart
    from magbridge.logs.merge import combine

    unnamed = [file for file in files if file not in reading.sensor_log]
    logs, errors = read_apart([*unnamed, *reading.sensor_log], reading.options)
    named = [path in reading.sensor_log for path in logs]
    return logs, combine([*logs.values()], named, reading.clock_offset), errors


def by_base_station(logs: Sequence[xr.Dataset], base: Path | None) -> list[xr.Dataset]:
    """Return the logs of a vehicle with the column ``daily_variation`` from a base station.

    The base station is the log `base`, or an observatory's log among `logs`; without both, the logs are
    returned unchanged.

    FormatError, DataError: the base station's log has no field, or does not cover the time of the logs.
    WrongUse: there are logs of several observatories.
    """
    from magbridge.field.reference import separate_observatories, station_gaps, with_daily_variation
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
    found = with_daily_variation(own, station)
    complain_all(station_gaps(found, str(station.attrs["source"])))
    return found


def chosen_parameters(named: Sequence[str], deployment: xr.Dataset, **options: Any) -> tuple[str, ...]:
    """Return the parameters of a fit: the names in `named`, or for ``auto`` the columns that improve it.

    ``auto`` tries positions, currents, temperatures and pressures, and prints to stderr how much each column
    improves the prediction of held-out parts. `options` are the options of
    :func:`~magbridge.calibration.fitting.parameter_choice.best_parameters`.

    WrongUse: `named` contains ``auto`` and other names.
    """
    from magbridge.calibration.fitting.parameter_choice import AUTO, best_parameters, lines
    from magbridge.logs.info import conditions, movers

    if AUTO not in named:
        return tuple(named)
    if len(named) > 1:
        raise WrongUse(f"--parameter {AUTO}: expected it alone, because {AUTO} chooses among all columns")
    offered = [*movers(deployment), *conditions(deployment)]
    taken, offers = best_parameters(deployment, offered, **options)
    none = f"--parameter {AUTO}: none of {' '.join(offered) or 'its columns'} moves the field"
    complain_all(lines(offers) or [none])
    return taken


def note_missing(calibration: mb.Calibration, deployment: xr.Dataset) -> None:
    """Warn on stderr of columns that the calibration needs but the log does not have."""
    complain_all(
        f"{deployment.attrs['source']}: no column {name!r}, which the calibration needs: every sample is "
        f"flagged, with a wider sigma; name the log's own column with --column {name}=THEIRS"
        for name in calibration.channels
        if name not in deployment
    )


def note_unused_grid(grid: Path | None, *logs: xr.Dataset) -> None:
    """Warn on stderr of logs for which the grid is not used, as all rows have ``reference_field``."""
    for log in logs if grid else ():
        if "reference_field" in log and log["reference_field"].notnull().all():
            complain(f"{log.attrs['source']}: has reference_field in every row, so --grid {grid} is not used")


def note_settings(*pieces: Mapping[str, Any]) -> None:
    """Warn on stderr if MB_* parameters changed during a bridge's log, from the attributes of its pieces."""
    from magbridge.logs.deployment import CHANGES_SETTING

    for attrs in pieces:
        if times := int(attrs.get(CHANGES_SETTING, 0)):
            often = "once" if times == 1 else f"{times} times"
            complain(
                f"{attrs['source']}: MB_* parameters were set {often} in the course of the log; it is "
                "corrected with those of its start (magbridge replay follows them)"
            )
            return
