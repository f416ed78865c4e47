"""Run the commands of the command line; the docstring of a command's function is its help.

Exit codes: 0 success, 1 the data do not allow the command, 2 wrong use. An error is one line on stderr.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from contextlib import suppress
from importlib import import_module

from cyclopts import CycloptsError, MissingArgumentError, UnusedCliTokensError

from magbridge.cli.common import FailedResult, app, complain, print_result
from magbridge.errors import MagbridgeError, MissingExtra

__all__ = ["app", "main", "report_error"]

ROOMS = ("bridge", "calibrate", "correct", "diagnose", "fleet", "logs", "navigate", "survey")
"""Modules with commands; importing a module adds its commands to `app`."""
for _room in ROOMS:
    import_module(f"{__name__}.{_room}")
ANALYSIS = "scipy xarray netCDF4 matplotlib ppigrf filterpy rich pandas threadpoolctl"
EXTRAS = {
    **dict.fromkeys(ANALYSIS.split(), "analysis"),
    "harmonica": "grids",
    "pymavlink": "dialect",
    "nicegui": "monitor",
    **dict.fromkeys(["polars", "distributed"], "fleet"),
}
"""Name of a package -> extra of magbridge that installs the package."""
ENDS = (signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""Signals that end a command; the system sends SIGHUP when the terminal is closed."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code; `arguments` defaults to those of the process."""
    with suppress(ValueError):  # signal handlers can be set on the main thread only
        for number in ENDS:
            if signal.getsignal(number) != signal.SIG_IGN:  # for example, nohup sets SIG_IGN
                signal.signal(number, _terminated)
    try:
        app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except BrokenPipeError:  # the program that reads the output has ended, such as `| head`
        sys.stderr.close()
    except (CycloptsError, MagbridgeError, ImportError, UnicodeEncodeError, OSError, MemoryError) as error:
        as_json = "--json" in (sys.argv[1:] if arguments is None else arguments)
        return report_error(error, as_json=as_json)
    except _Terminated as end:
        signal.signal(end.number, signal.SIG_DFL)
        signal.raise_signal(end.number)
    except SystemExit as end:  # raised by rich if that happens while it prints the help
        if not isinstance(end.__context__, BrokenPipeError):
            raise
    return 0


def report_error(error: Exception, *, as_json: bool = False) -> int:
    """Print an error that ends a command, also as JSON if `as_json`, and return the exit code."""
    sentence, code = _explained(error)
    if as_json and not isinstance(error, FailedResult):
        print_result({"error": " ".join(sentence.split()), "exit_code": code}, "", as_json=True)
    return complain(sentence, code)


def _explained(error: Exception) -> tuple[str, int]:
    """Return message and exit code of an error; raise an ImportError again if no extra has the module."""
    sentence, code = _no_handle(error), 1
    match error:
        case _ if sentence:
            pass
        case CycloptsError():
            sentence, code = _misuse(error), 2
        case MagbridgeError():
            sentence, code = str(error), error.exit_code
        case ImportError():
            extra = EXTRAS.get((error.name or "").partition(".")[0])
            if extra is None:
                raise error
            sentence, code = str(MissingExtra(str(error.name), extra)), 2
        case UnicodeEncodeError():  # netCDF and JSON reject names that the locale cannot encode
            sentence = f"{error.object}: expected a name in {error.encoding}; rename the file"
        case IsADirectoryError(filename=name) if name:
            sentence = f"{name}: expected a file, got a folder; name a file in it"
        case OSError(strerror=str(reason)):  # the operating system denies a file, a folder or memory
            sentence = f"{error.filename}: {reason}" if error.filename else reason
        case _:
            sentence = str(error) or "not enough memory"
    return sentence, code


def _misuse(error: CycloptsError) -> str:
    if isinstance(error, UnusedCliTokensError):
        first, *others = error.unused_tokens or ("",)
        unused = f"{first} and {len(others)} more" if others else first
        return f"{unused}: unexpected argument; an option with several values is repeated for each"
    if isinstance(error, MissingArgumentError) and error.keyword is None:  # the option itself is missing
        return str(error).replace("requires an argument", "is required")
    return str(error)


class _Terminated(SystemExit):
    """Exception that removes partial files on its way up, before the signal `number` ends the process."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def _terminated(number: int, _: object) -> None:
    raise _Terminated(number)


def _no_handle(error: BaseException) -> str:
    """Return a message about too many open files if they caused `error`; else an empty text."""
    reason: BaseException | None = error
    while reason is not None:
        if os.strerror(errno.EMFILE) in str(reason) or getattr(reason, "errno", None) == errno.EMFILE:
            return "too many open files: this process has reached its limit; raise it (ulimit -n)"
        reason = reason.__cause__ or reason.__context__
    return ""
