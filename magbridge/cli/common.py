"""What the commands share: the application, common arguments, printing of results."""

from __future__ import annotations

import datetime as dt
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from cyclopts import App, Parameter, Token

from magbridge import __version__
from magbridge.errors import DataError, FormatError, WrongUse
from magbridge.files import existing
from magbridge.logs import Options, suffixes
from magbridge.logs.registry import is_bag

__all__ = [
    "AS_THEY_SAY", "NO_SCALAR", "Base", "CalibrationOutput", "Day", "FailedResult", "Folder", "Grid",
    "Heading", "Json", "Log", "Output", "Plot", "ReadingOptions", "SavedCalibration", "ScalarOptions",
    "Whole", "app", "check_inputs", "command", "complain", "file_to_write", "folder_to_write",
    "logs_to_read", "print_error", "print_result",
]  # fmt: skip


def _default(value: object) -> object:
    """Return the default as the help shows it; None where it is not shown."""
    return None if value is False or value in {(), ""} else value


app = App(
    name="magbridge",
    help="A magnetometer bridge for vehicles whose own iron moves.",
    version=__version__,
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
            raise ValueError("It is a folder.")
        if not path.parent.is_dir():
            raise ValueError(f"The folder {path.parent} does not exist.")
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"The folder {path.parent} cannot be written to.")
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError(f"Its name must end in {' or '.join(suffixes)}.")

    return check


def _log_to_write(kind: Any, path: Any) -> None:
    file_to_write(*suffixes(write=True))(kind, path)


def folder_to_write(_: Any, path: Any) -> None:
    """Validate a folder to write to, before any work is done."""
    if path is None:
        return
    if path.exists() and not path.is_dir():
        raise ValueError("It is a file.")
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise ValueError(f"{there} is a file.")
    if not os.access(there, os.W_OK):
        raise ValueError(f"The folder {there} cannot be written to.")


def _whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """Read a whole number; cyclopts would round 1.5 to 2."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected a whole number, not {tokens[0].value}.") from None


def _day(_: Any, tokens: Sequence[Token]) -> dt.date:
    """Read a date; cyclopts would also take a time of day, which no log counts from."""
    try:
        return dt.date.fromisoformat(tokens[0].value)
    except ValueError:
        raise ValueError(f"expected YYYY-MM-DD, not {tokens[0].value}.") from None


Day = Annotated[dt.date | None, Parameter(converter=_day)]


@Parameter(name="*")
@dataclass(frozen=True)
class ReadingOptions:
    """How to read logs.

    Parameters
    ----------
    date
        The day (UTC, YYYY-MM-DD) of a log whose times count from the boot: the Earth's field is that day's.
    compass
        Which of several compasses to use: its number, from 0, or its device id. If not given: the one that
        the log says was in use.
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
        A columns.toml that does so for a whole file: renames, scales, declares units and what headings refer
        to.
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
        The column of a scalar magnetometer, nT. calibrate also fits its compensation, by the vector's
        direction and by telemetry, into the same file. survey makes the map of it: lag, lever arm and heading
        error are fitted together with the crustal field and the lines' levels. The channels that disturb it
        are those of --parameter; auto, and in calibrate also no --parameter: all telemetry of the log.
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
            raise WrongUse("--reference scalar, --lag and --lever: give --scalar COLUMN, too")
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
"""Logs are read as they say themselves."""
NO_SCALAR = ScalarOptions()
"""No scalar magnetometer."""
Output = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write())]
CalibrationOutput = Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".json"))]
SavedCalibration = Annotated[Path | None, Parameter(validator=file_to_write(".json"))]
Log = Annotated[Path, Parameter(name=["--output", "-o"], validator=_log_to_write)]
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
        raise WrongUse(f"{output}: is among the files to read; choose another file to write")
    return files


def logs_to_read(files: tuple[Path, ...], output: Path | None = None, *others: Path | None) -> None:
    """Check, before anything heavy is imported, that logs are there and are not written over.

    `others` are other files to read; one of them may be a folder, as a grid is.

    WrongUse: as :func:`check_inputs`. FormatError: one is not there, or a log is empty.
    """
    for path in check_inputs(files, output, *others):
        if not is_bag(path) and not existing(path).stat().st_size:
            raise FormatError(path, "expected a log, the file is empty")
    for other in others:
        if other is not None and not other.is_dir():
            existing(other)


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
