"""Define all errors as one tree.

Every error carries values and builds its own one-line sentence from them. Each also inherits from the
built-in error of its kind::

    MagbridgeError
    ├── WrongUse                          exit 2: the request itself is wrong
    │   └── ConfigError (ValueError)      a key of a configuration or scenario file
    ├── DataError                         exit 1: the data do not allow it
    │   ├── FormatError (ValueError)      a file whose content is wrong, with row and column
    │   ├── CalibrationError (ValueError) a calibration that cannot be fitted, read or used
    │   └── OutOfRange (ValueError)       a date, position or grid cell outside the data
    ├── PortError (OSError)               exit 1: a port that cannot be opened, read or written
    ├── WriteError (OSError)              exit 1: a file that cannot be written; it is as it was before
    ├── PluginError (RuntimeError)        exit 1: another package's driver or format that is faulty
    └── MissingExtra (ImportError)        exit 2: an optional dependency that is not installed
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

__all__ = [
    "AbsentColumns", "CalibrationError", "ConfigError", "DataError", "FormatError", "MagbridgeError",
    "MissingExtra", "NoSolutionError", "OutOfRange", "PluginError", "PortError", "WriteError", "WrongUse",
]  # fmt: skip


class MagbridgeError(Exception):
    """Root of the tree; ``exit_code`` is what the command line ends with."""

    exit_code = 1

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the values, too: the sentence in ``args`` is not what the constructor takes."""
        return _rebuilt, (type(self), self.args, self.__dict__)


def _rebuilt(kind: type[MagbridgeError], args: tuple[Any, ...], values: dict[str, Any]) -> MagbridgeError:
    """Rebuild an error from its pickled values."""
    error = kind.__new__(kind, *args)
    error.args = args
    error.__dict__.update(values)
    return error


class WrongUse(MagbridgeError):
    """The request itself is wrong, whatever the data."""

    exit_code = 2


class ConfigError(WrongUse, ValueError):
    """A key of a configuration or scenario file: ``file: key: expected ...``.

    Without a key, the file itself cannot be read, which ends a command as any other such file does.
    """

    def __init__(self, file: str | Path, key: str, expected: str) -> None:
        self.file, self.key, self.expected = Path(file), key, expected
        self.exit_code = 2 if key else 1
        super().__init__(f"{file}: {key}: {expected}" if key else f"{file}: {expected}")


class DataError(MagbridgeError):
    """The data do not allow the operation."""


class FormatError(DataError, ValueError):
    """A file whose content is wrong: ``file: row 3, column 'mag_x': expected ...``."""

    def __init__(
        self, file: str | Path, expected: str, *, row: int | None = None, column: str | None = None
    ) -> None:
        self.file, self.expected, self.row, self.column = Path(file), expected, row, column
        where = ", ".join([f"row {row}"] * (row is not None) + [f"column {column!r}"] * bool(column))
        super().__init__(": ".join(part for part in (str(file), where, expected) if part))


class AbsentColumns(FormatError):
    """A file that lacks columns that the user declares."""

    def __init__(self, file: str | Path, expected: str, names: tuple[str, ...], **where: Any) -> None:
        self.names = names
        super().__init__(file, expected, **where)


class CalibrationError(DataError, ValueError):
    """A calibration that cannot be fitted, read or used."""


class NoSolutionError(CalibrationError):
    """A fit that collapsed or did not converge; another method may have a solution."""


class OutOfRange(DataError, ValueError):
    """A date, position or grid cell outside the data: ``quantity = value: expected range``."""

    def __init__(self, quantity: str, value: object, covered: str) -> None:
        self.what, self.value, self.covered = quantity, value, covered
        super().__init__(f"{quantity} = {value}: {covered}")


class PortError(MagbridgeError, OSError):
    """A port that cannot be opened, read or written: ``port: reason``."""

    def __init__(self, port: str, reason: str) -> None:
        self.port, self.reason = port, reason
        super().__init__(f"{port}: {reason}")


class WriteError(MagbridgeError, OSError):
    """A file that cannot be written: ``file: cannot be written: reason``."""

    def __init__(self, file: str | Path, reason: str) -> None:
        self.file, self.reason = Path(file), reason
        super().__init__(f"{file}: cannot be written: {reason}")


class PluginError(MagbridgeError, RuntimeError):
    """Another package's driver, format or term that is faulty: names it, and what went wrong where."""

    def __init__(self, plugin: str, fault: str) -> None:
        self.plugin, self.fault = plugin, " ".join(fault.split())
        super().__init__(f"{plugin}: {self.fault}")


def _installed_from() -> str:
    """Return pip's source of magbridge: the file or folder that it was installed from, else its name."""
    import json  # noqa: PLC0415 - needed only in this error
    from importlib.metadata import PackageNotFoundError, distribution  # noqa: PLC0415 - slow to import
    from urllib.parse import unquote, urlsplit  # noqa: PLC0415 - as above

    try:
        recorded = distribution("magbridge").read_text("direct_url.json")
    except PackageNotFoundError:  # run from its sources
        recorded = None
    url = urlsplit(json.loads(recorded or "{}").get("url", ""))
    return unquote(url.path) if url.scheme == "file" else "magbridge"


class MissingExtra(MagbridgeError, ImportError):
    """An optional dependency that is not installed: names the extra that brings it."""

    exit_code = 2

    def __init__(self, package: str, extra: str) -> None:
        self.package, self.extra = package, extra
        super().__init__(f"{package} is not installed: pip install '{_installed_from()}[{extra}]'")
