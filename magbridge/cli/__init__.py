"""The command line: one thin function a command; the help is its docstring.

Exit codes: 0 done, 1 the data do not allow it, 2 wrong use. What is wrong goes to stderr as one line.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

from cyclopts import CycloptsError, MissingArgumentError, UnusedCliTokensError

from magbridge.cli import ashore, bridge, calibrate, diagnose, navigate
from magbridge.cli.common import app, complain
from magbridge.errors import MagbridgeError, MissingExtra

__all__ = ["app", "ashore", "bridge", "calibrate", "diagnose", "main", "navigate"]

EXTRAS = {
    **dict.fromkeys(
        [
            "scipy",
            "xarray",
            "netCDF4",
            "matplotlib",
            "ppigrf",
            "filterpy",
            "rich",
            "pandas",
            "pymavlink",
            "threadpoolctl",
        ],
        "analysis",
    ),
    "harmonica": "grids",
    "nicegui": "monitor",
}
"""Which extra brings a package."""
ENDS = (signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""What ends a command: it is told to, or its terminal is gone."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return its exit code."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if (
            getattr(sys, name) is None
        ):  # closed by whoever started us; in this order each gets its own descriptor
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - as long as the process
    with suppress(ValueError):  # on another thread than the first: signals are another's business
        _heed_signals()
    try:
        app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        return complain(_misuse(error), 2)
    except MagbridgeError as error:
        return complain(str(error), error.exit_code)
    except ImportError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return complain(str(MissingExtra(str(error.name), extra)), 2)
    except BrokenPipeError:  # the reader of our output has gone, as `| head` does
        sys.stderr.close()
    except (OSError, MemoryError) as error:  # the system does not give a file, a folder, room
        return complain(_reason(error), 1)
    except _Terminated as end:
        signal.signal(end.number, signal.SIG_DFL)
        signal.raise_signal(end.number)
    except SystemExit as end:  # what rich makes of a reader that has gone, while it prints the help
        if not isinstance(end.__context__, BrokenPipeError):
            raise
    return 0


def _misuse(error: CycloptsError) -> str:
    if isinstance(error, UnusedCliTokensError):
        unused = " ".join(error.unused_tokens or ())
        return f"{unused}: unexpected argument; an option with several values is repeated for each"
    if isinstance(error, MissingArgumentError) and error.keyword is None:  # the option itself is not there
        return str(error).replace("requires an argument", "is required")
    return str(error)


class _Terminated(SystemExit):
    """The process is to end by the signal `number`; what is half-written goes first."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def _heed_signals() -> None:
    for number in ENDS:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, _terminated)


def _terminated(number: int, _: object) -> None:
    raise _Terminated(number)


def _reason(error: OSError | MemoryError) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error) or "not enough memory"
