"""Read Slocum logs: flight ``.dbd .mbd .sbd``, science ``.ebd .nbd .tbd``, packed ``.dcd``, text ``.dba``.

Each row is a cycle of the flight computer; values that were not updated in a cycle are interpolated linearly.
The flight and the science file of one name are read together. The list of sensors is read from the file
``<crc>.cac`` in the folder of the file, or in a folder ``cac`` or ``cache`` there or above. A science file
begins with start values of the CTD, 0 degC and 0 bar. They are not measurements and are left out.

Angles are converted to degrees; ``heading`` is the compass's, magnetic. A Slocum logs no vector magnetometer,
so the deployment has no ``mag_x``. The header and the list of sensors are checked first, because dbdreader
does not terminate on a truncated header.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.deployment import deployment, sliced
from magbridge.logs.fields import Track, degrees, field_maps, interpolated
from magbridge.logs.registry import FLIGHT

TAG = re.compile(rb"(\w+):\s*(.*)")
SENSOR_LINE = re.compile(rb"s:\s+[TF]\s+-?\d+\s+-?\d+\s+[1248]\s+[!-~]+\s+[!-~]+\s*")
"""Line of a sensor, as ``s: T 0 0 4 m_roll rad``: logged or not, two indices, bytes, name, unit."""
MAX_HEADER_BYTES = 1 << 16
"""Bytes that are read to find the header; no header is longer."""
CACHES = ".", "cac", "cache", "../cac", "../cache"
"""Folders, relative to the folder of a file, in which its list of sensors may be."""
MAX_SENSOR_GAP_S = 300.0
"""Longest interval between two updates of a sensor that is interpolated, s."""
Tracks = dict[str, Track]
"""Sensor -> times and values of its updates."""
CTD_SENSORS = "sci_water_temp", "sci_water_pressure"
ASCII_HEADER = re.compile(rb"\w+:.*")
"""Header line of a ``dbd2asc`` text; names, units, sizes, and a line for each cycle follow the header."""
CLOCK_SENSORS = b"m_present_time", b"sci_m_present_time"
FILL = 69_696_969.0
"""Code of an unknown position, degrees and minutes written together."""
SCIENCE = {flight: science for science, flight in FLIGHT.items()}
SLOCUM_FIELDS = field_maps("slocum")[""]
SENSORS = [one.field for one in SLOCUM_FIELDS]


def _import() -> Any:
    """Import dbdreader without letting it make a directory in the user's home."""
    home = os.environ.get("HOME")
    try:
        with tempfile.TemporaryDirectory() as elsewhere:
            os.environ["HOME"] = elsewhere
            import dbdreader  # noqa: PLC0415 - under another HOME
    except ImportError:
        raise MissingExtra("dbdreader", "formats") from None
    finally:
        os.environ.pop("HOME", None)
        if home is not None:
            os.environ["HOME"] = home
    logging.getLogger("dbdreader.py").setLevel(logging.ERROR)
    return dbdreader


dbdreader = _import()


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield a flight and a science file of one name, or one of them, in pieces of at most `rows` rows."""
    flight: Path | None = path
    science = None
    if other := (SCIENCE | FLIGHT).get(path.suffix.lower()):
        partner = path.with_suffix(other.upper() if path.suffix.isupper() else other)
        there = partner if partner.is_file() else None
        flight, science = (path, there) if path.suffix.lower() in SCIENCE else (there, path)
    tracks = {**_read(flight), **_measured(_read(science))}
    base = "m_present_time" if "m_present_time" in tracks else "sci_m_present_time"
    if base not in tracks or not len(tracks[base][0]):
        raise FormatError(path, "expected rows, there are none")
    time = tracks[base][0]
    if len(time) > 1 and time[0] == time[1]:  # some files hold their first cycle twice
        time = time[1:]
    columns, units = interpolated(SLOCUM_FIELDS, tracks, time, MAX_SENSOR_GAP_S)
    dataset = deployment(path, time, columns, units, {"heading_reference": "magnetic"})
    yield from sliced(dataset, rows)


def _measured(tracks: Tracks) -> Tracks:
    """Return the tracks of a science file without the CTD's start values, which are all 0 at one time."""
    ctd = {name: tracks[name] for name in CTD_SENSORS if name in tracks}
    unset = [when[value == 0.0] for when, value in ctd.values()]
    if not unset:
        return tracks
    start = reduce(np.intersect1d, unset)
    return tracks | {
        name: (when[keep], value[keep])
        for name, (when, value) in ctd.items()
        for keep in [~np.isin(when, start)]
    }


def _read(path: Path | None) -> Tracks:
    """Return the times and values of the updates of each sensor in :data:`SLOCUM_FIELDS` that a file has."""
    if path is None:
        return {}
    with path.open("rb") as file:
        if b"DBD_ASC" in file.readline():
            return _read_ascii(path)
    lists = _check_header(path)
    # dbdreader writes the list of sensors to the folder in which it looks for the list
    with tempfile.TemporaryDirectory() as scratch:
        for cache in reversed(lists):  # of two lists, the nearest to the file remains
            link = Path(scratch, cache.name.lower())
            link.unlink(missing_ok=True)
            link.symlink_to(cache.resolve())
        try:
            file = dbdreader.DBD(str(path), cacheDir=scratch)
            wanted = [name for name in (file.timeVariable, *SENSORS) if name in file.parameterNames]
            tracks = file.get(*wanted)
        except dbdreader.DbdError as error:
            if error.value == dbdreader.DBD_ERROR_CACHE_NOT_FOUND:
                cache_id = next(iter(error.data.missing_cache_files))
                expected = f"expected {cache_id}.cac, the list of its sensors, next to it or in a folder cac"
                raise FormatError(path, expected) from None
            raise FormatError(path, f"expected a Slocum file: {error}") from None
        except (ValueError, KeyError, IndexError, UnicodeDecodeError, RuntimeError, OverflowError) as error:
            raise FormatError(path, f"expected a whole Slocum file: {error}") from None
    tracks = tracks if len(wanted) > 1 else [tracks]
    return {name: (np.asarray(t), np.asarray(v)) for name, (t, v) in zip(wanted, tracks, strict=True)}


def _read_ascii(path: Path) -> Tracks:
    """Return the tracks of a text that ``dbd2asc`` wrote (``.dba``); NaN stands for no update."""
    lines = path.read_bytes().splitlines()
    start = next((k for k, line in enumerate(lines) if not ASCII_HEADER.fullmatch(line)), len(lines))
    try:
        names, units, _ = (line.split() for line in lines[start : start + 3])
        rows = [line.split() for line in lines[start + 3 :] if line.strip()]
        values = np.array([row for row in rows if len(row) == len(names)], float).reshape(-1, len(names)).T
        clock = next(values[names.index(name)] for name in CLOCK_SENSORS if name in names)
    except (ValueError, StopIteration):
        expected = "expected names, units, sizes and rows of numbers, as dbd2asc writes them"
        raise FormatError(path, expected) from None
    tracks = {}
    for name, unit, written in zip(names, units, values, strict=True):
        if (ours := name.decode("ascii", "replace")) in {*SENSORS, "m_present_time", "sci_m_present_time"}:
            place = np.where(np.abs(written) < FILL, degrees(written), np.nan)
            track = place if unit in {b"lat", b"lon"} else written
            there = np.isfinite(clock) & np.isfinite(track)
            tracks[ours] = (clock[there], track[there])
    return tracks


def _check_header(path: Path) -> list[Path]:
    """Check the header of a file and the list of its sensors; return the paths that may hold the list."""
    with path.open("rb") as file:
        lines = file.read(MAX_HEADER_BYTES).split(b"\n")
    if not lines[0].startswith(b"dbd_label:"):
        return list(_caches(path))
    tags = {found[1]: found[2].strip() for line in lines[:40] if (found := TAG.fullmatch(line))}
    count = tags.get(b"num_ascii_tags", b"")
    if not count.isdigit() or not 3 <= int(count) < len(lines):
        raise FormatError(path, "the header is cut off or damaged")
    if tags.get(b"sensor_list_factored") == b"0":
        return []
    crc = tags.get(b"sensor_list_crc", b"").decode("ascii", "replace").lower()
    lists = [cache for cache in _caches(path) if cache.stem.lower() == crc][:1]
    for cache in lists:
        for row, line in enumerate(cache.read_bytes().splitlines(), 1):
            if not SENSOR_LINE.fullmatch(line) and line.strip():
                what = line[:40].decode("ascii", "backslashreplace")
                raise FormatError(cache, f"expected a sensor, not {what!r}: damaged", row=row)
    return lists


def _caches(path: Path) -> Iterator[Path]:
    for folder in CACHES:
        yield from (path.parent / folder).glob("*.[cC][aA][cC]")
