"""Table of formats: the module of each format, and the recognition of its files.

The first bytes of a file determine its format. The suffix counts only if they are inconclusive (CSV, or a log
that begins with damage). Text files may be compressed by gzip, bzip2 or xz. Another package adds a format
with an entry point in the group ``magbridge.formats``: the suffix without its dot, and the module. The folder
``examples/format`` has an example.

The module of a format has ``chunks(path, rows)``, or ``chunks(path, rows, options)`` if it uses
:class:`~magbridge.logs.mapping.Options`. This function yields deployments of at most `rows` rows in the order
of the file, or pairs of a deployment and its row numbers. It raises FormatError for a file that it cannot
read. :mod:`magbridge.logs.checks` finds faults in times and values. A format that can be written also has
``FileWriter(path)`` with ``append(dataset, first=...)`` and ``close()``. If its files cannot hold attributes,
the writer's ``metadata`` are the bytes of a separate metadata file.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import zlib
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from magbridge.errors import FormatError, PluginError
from magbridge.plugins import blamed, load, plugins

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

FLIGHT = {".ebd": ".dbd", ".nbd": ".mbd", ".tbd": ".sbd", ".ecd": ".dcd", ".ncd": ".mcd", ".tcd": ".scd"}
"""Suffix of a Slocum's science file -> suffix of its flight file; if both exist, both are read."""
LEADS = {**FLIGHT, ".log": ".eng"}
"""Suffix of a file that is read with another file of the same name -> suffix of the other file."""
SEAEXPLORER = re.compile(r"(?P<mission>.+)\.(?P<kind>gli|pld)\d?\.\w+\.(?P<dive>\d+)(\.gz)?")
"""Name of a SeaExplorer's file of one dive, as sea035.12.pld1.raw.36.gz; gli: navigation, pld: payload."""
PACKED = ".gz", ".bz2", ".xz"
"""Suffixes of compressed files; the suffix before them states the format."""
SIGNATURE_BYTES = 4096
"""Number of bytes at the beginning of a file by which its format is recognised."""


def seaexplorer_dive(name: str, kind: str) -> tuple[str, str] | None:
    """Return mission and dive of a SeaExplorer's file of this kind (``gli``, ``pld``); None for others."""
    named = SEAEXPLORER.fullmatch(name)
    return (named["mission"], named["dive"]) if named and named["kind"] == kind else None


class Format(NamedTuple):
    """File format: its module, and the properties by which its files are recognised and read."""

    module: str
    suffixes: tuple[str, ...]
    signature: bytes | None = None
    """Regular expression that matches the first bytes of a file; None if only the suffix counts."""
    writes: bool = False
    writer: str = "FileWriter"
    """Class in the module that writes files."""
    guarded: bool = False
    """True to read files in a child process, because damage may hang or crash the library that reads them."""
    compasses: bool = False
    """True if the module applies the option for the compass; else the columns are renamed afterwards."""
    maps_columns: bool = False
    """True if the module applies declared columns; else the columns are renamed afterwards."""
    packed: bool = False
    """True if its files may be compressed."""
    plugin: EntryPoint | None = None
    """Entry point of a format in another package; None for a built-in format."""

    def load(self) -> Any:
        """Return the module; PluginError: another package's module cannot be imported or lacks ``chunks``."""
        if self.plugin is None:
            return import_module(self.module)
        module = load(self.plugin)
        with self.blamed():
            if not hasattr(module, "chunks"):
                raise AttributeError(f"{self.module} lacks chunks(path, rows)")
        return module

    def blamed(self) -> AbstractContextManager[None]:
        """Return a context that turns exceptions of another package's code into a PluginError."""
        return nullcontext() if self.plugin is None else blamed(self.plugin)


FORMATS: dict[str, Format] = {
    "netcdf": Format(
        "magbridge.logs.netcdf", (".nc",), rb"CDF[\x01\x02\x05]|\x89HDF\r\n\x1a\n", writes=True, guarded=True
    ),
    "parquet": Format("magbridge.logs.parquet", (".parquet",), rb"PAR1", writes=True, guarded=True),
    "ardupilot": Format(
        "magbridge.logs.ardupilot", (".bin", ".log"), rb"\xa3\x95\x80\x80|FMT, ?\d+, ?\d+,", compasses=True
    ),
    "px4": Format("magbridge.logs.px4", (".ulg",), rb"ULog\x01\x12\x35", guarded=True, compasses=True),
    "slocum": Format("magbridge.logs.slocum", (*FLIGHT, *FLIGHT.values()), rb".{0,8}dbd_label", guarded=True),
    "ros": Format(
        "magbridge.logs.rosbag",
        (".bag", ".db3", ".mcap"),
        rb"#ROSBAG V2|\x89MCAP0\r\n(?!\x01.{12}magbridge)|SQLite format 3\0",
        guarded=True,
        compasses=True,
    ),
    "mcap": Format(
        "magbridge.logs.mcap",
        (".mcap",),
        rb"\x89MCAP0\r\n\x01.{12}magbridge",  # its profile: ours, not a robot's
        writes=True,
        guarded=True,
    ),
    # 8 bytes of time, µs since 1970 (before 2079), then a frame of either MAVLink
    "telemetry": Format(
        "magbridge.logs.telemetry", (".tlog",), rb"\x00[\x00-\x0c].{6}[\xfd\xfe]", writes=True, compasses=True
    ),
    "csv": Format("magbridge.logs.text", (".csv",), writes=True, maps_columns=True, packed=True),
    "seaexplorer": Format(
        "magbridge.logs.seaexplorer", (), rb"Timestamp;NavState;|PLD_REALTIMECLOCK;", packed=True
    ),
    "iaga2002": Format("magbridge.logs.iaga", (), rb" ?Format +IAGA-2002", packed=True),
    "seaglider": Format("magbridge.logs.seaglider", (".eng",), rb"%?version: [\d.]+\s+%?glider:"),
    "magarrow": Format(
        "magbridge.logs.text", (".magarrow.csv",), writes=True, writer="MagArrowWriter", maps_columns=True
    ),
    "geosoft": Format(
        "magbridge.logs.text", (".xyz",), writes=True, writer="GeosoftWriter", maps_columns=True, packed=True
    ),
    "text": Format(
        "magbridge.logs.text",
        (".txt", ".tsv", ".dat", ".asc", ".m77t", ".jsonl", ".ndjson"),
        maps_columns=True,
        packed=True,
    ),
}
"""Name -> format; the first format whose signature matches reads the file."""
UNREADABLE = {
    rb"PK\x03\x04|\xd0\xcf\x11\xe0": "a spreadsheet, or an archive: save it as CSV, or unpack it",
    rb"\x28\xb5\x2f\xfd|7z\xbc\xaf|\x1f\x9d|\x1f\x8b|BZh|\xfd7zXZ": "it is compressed: unpack it first",
    rb"MATLAB 5\.0": "a .mat of MATLAB: save it as CSV (writetable)",
    rb"%PDF|\s*<(!DOCTYPE|html|\?xml)": "a document, no table",
    rb"#\s*\n# Header Description:": "a log of Android's GnssLogger: save its lines UncalMag as CSV",
    rb"\s*(?!\{[^\n]*\}\s*\n\s*\{)[{\[]\s*[\"{\[]": "JSON: save it as CSV, or as one object a line (.jsonl)",
    rb"[A-Z]{3} [A-Z]{3}\d{4} \d{3} \d\d [A-Z]{4} ": "INTERMAGNET's IMF: ask for IAGA-2002",
}
"""First bytes of files that cannot be read -> kind of file, and remedy."""


@cache
def _plugins() -> dict[str, Format]:
    """Return the formats of other packages, without those that claim a built-in suffix."""
    ours = {suffix for one in FORMATS.values() for suffix in one.suffixes}
    others = {f".{name.lower()}": point for name, point in plugins("magbridge.formats").items()}
    return {
        suffix: Format(point.value, (suffix,), writes=_writes(point), plugin=point)
        for suffix, point in others.items()
        if suffix not in ours
    }


def _formats() -> list[Format]:
    return [*FORMATS.values(), *_plugins().values()]


def _writes(point: EntryPoint) -> bool:
    """Return True if another package's format can be written, False also if its module fails to load."""
    try:
        return hasattr(load(point), "FileWriter")
    except PluginError:
        return False


def suffixes(*, write: bool = False) -> list[str]:
    """Return the suffixes of files that can be read, or if `write`, that can be written."""
    return sorted({suffix for one in _formats() for suffix in one.suffixes if one.writes or not write})


def format_of(path: Path, *, write: bool = False) -> Format:
    """Return the format of an existing file, or the format in which a file of this name is written.

    FormatError: neither its first bytes nor its name are those of a known format.
    """
    start = b"" if write or is_bag(path) else _start(path)
    signed = (one for one in _formats() if one.signature and re.match(one.signature, start, re.DOTALL))
    found = FORMATS["ros"] if is_bag(path) else next(signed, None)
    packed = not write and path.is_file() and _unpacker(path) is not None
    if found is None and (
        other := next((text for mark, text in UNREADABLE.items() if re.match(mark, start)), None)
    ):
        raise FormatError(path, f"expected a log, found {other}")
    if found is None:
        known = suffixes(write=write)
        name = Path(path.stem if packed and path.suffix.lower() in PACKED else path)
        double = "".join(name.suffixes[-2:]).lower()
        suffix = double if double in known else name.suffix.lower()
        if suffix not in known:
            raise FormatError(path, f"expected a file name that ends in one of {' '.join(known)}")
        found = next(one for one in _formats() if suffix in one.suffixes and (one.writes or not write))
    if packed and not found.packed:
        raise FormatError(path, "expected a log, it is compressed: unpack it first")
    return found


def is_bag(path: Path) -> bool:
    """Return True if a folder is a bag of ROS 2, which is read as one file."""
    return (path / "metadata.yaml").is_file()


def _start(path: Path) -> bytes:
    """Return the first bytes of a file, decompressed."""
    try:
        with opened(path) as file:
            return file.read(SIGNATURE_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except DECOMPRESSION_ERRORS as error:
        raise FormatError(path, f"expected a whole compressed file: {error}") from None


def metadata_path(path: Path) -> Path:
    """Return the path of a table's metadata: W3C, *Model for Tabular Data and Metadata*, section 5.3."""
    return path.with_name(f"{path.name}-metadata.json")


PACKERS: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\0": lzma.open}
"""First bytes of a compressed file -> function that opens it."""
DECOMPRESSION_ERRORS = EOFError, zlib.error, lzma.LZMAError
"""Errors that damaged compressed files cause, in addition to OSError."""


def _unpacker(path: Path) -> Any:
    """Return the function that opens a compressed file; None for a file that is not compressed."""
    with path.open("rb") as file:
        start = file.read(6)
    return next((unpack for mark, unpack in PACKERS.items() if start.startswith(mark)), None)


def opened(path: Path) -> IO[bytes]:
    """Open a file to read its bytes, decompressed if it is compressed."""
    opened_file: IO[bytes] = (_unpacker(path) or Path.open)(path, "rb")
    return opened_file
