"""Robots' logs: bags of ROS 1 (``.bag``) and ROS 2 (a folder with ``metadata.yaml``), and MCAP, by rosbags.

A row is a ``sensor_msgs/MagneticField`` (tesla); what else is read, and how it is turned into our frames,
says :mod:`.ros_messages`. Times are those of the message's header where it has one, else the recorder's.

Many drivers publish gauss or microtesla where the message says tesla. A field of such a size is recognised,
since the Earth's is within a factor of ten everywhere: it is converted, with a word, never silently.

References
----------
ROS REP 103, "Standard Units of Measure and Coordinate Conventions", https://www.ros.org/reps/rep-0103.html
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.autopilot import BootRun, Magnetometer, Series, pieces
from magbridge.logs.compasses import LogCompass, rate
from magbridge.logs.deployment import NOTES, noted
from magbridge.logs.ros_messages import FRAMES_HISTORY, MAGNETIC_FIELD, MESSAGE_KINDS, MessageKind

try:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.rosbag2 import ReaderError
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
except ImportError:
    raise MissingExtra("rosbags", "ros") from None

if TYPE_CHECKING:
    from magbridge.logs.options import Options

__all__ = ["chunks"]

STORAGES = {".mcap": McapReader, ".db3": Sqlite3Reader}
"""Readers of one file of a ROS 2 bag, without its folder."""
ROSBAG_ERRORS = (AnyReaderError, ReaderError, SerdeError, TypesysError, sqlite3.Error)
ROS_STAMP = np.dtype([("", "V4"), ("s", "<i4"), ("ns", "<u4")])
"""Where both ROS 1 (after the sequence number) and ROS 2 (after the encapsulation) have a header's stamp."""
LITTLE = b"\x00\x01"
MIN_REAL_TIME_S = 315_532_800.0
"""s: earlier stamps are those of a simulation, which begins at 0."""
EARTH = 15e3, 150e3
"""nT: a median length within is the Earth's field with a vehicle's; a factor of ten, so one unit fits."""
TESLA = 1e-6, 1e-2
"""T: a median length within is believed to be in tesla."""
FIELD_UNITS = ("G", "uT", "mG", "mT", "nT")


class _Stream(NamedTuple):
    """The messages of a topic: times (n,), s, and values (n,) by name."""

    topic: str
    kind: MessageKind
    time: FloatArray
    values: dict[str, FloatArray]


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the bag in pieces of at most `rows` rows; the values that are read are held whole.

    FormatError: not a bag, or no ``MagneticField`` in it.
    """
    try:
        with _opened(path) as bag:
            streams, lost = _streams(bag)
    except ROSBAG_ERRORS as error:
        raise FormatError(path, f"expected a ROS bag: {error}") from None
    except (OSError, EOFError, KeyError, IndexError, ValueError, AssertionError) as error:
        # what rosbags raises where the file, not a message, is damaged
        raise FormatError(
            path, f"expected a ROS bag; it is damaged: {str(error) or type(error).__name__}"
        ) from None
    fields = [stream for stream in streams if stream.kind is MESSAGE_KINDS[MAGNETIC_FIELD]]
    if not fields:
        topics = " ".join(stream.topic for stream in streams) or "nothing that is read"
        raise FormatError(path, f"expected sensor_msgs/MagneticField; there is: {topics}")
    notes: list[str] = []
    mags = [_magnetometer(number, stream, notes) for number, stream in enumerate(fields)]
    boot = float(np.median(mags[0].time)) < MIN_REAL_TIME_S
    run = BootRun(mags, _telemetry(streams), None if boot else 0.0)
    attrs = {"values_dropped": lost, "history": "\n".join([FRAMES_HISTORY, *notes])}
    for part in pieces(path, rows, [run], attrs, options.compass if options else None):
        yield part.assign_attrs({NOTES: "\n".join([*notes, *noted(part.attrs)])}) if notes else part
        notes = []


def _magnetometer(number: int, stream: _Stream, notes: list[str]) -> Magnetometer:
    tesla = np.stack([stream.values[axis] for axis in "xyz"])
    length = float(np.nanmedian(np.linalg.norm(tesla, axis=0)))
    unit = _unit(length)
    if unit != "T":
        notes.append(f"{stream.topic}: {length:.3g} T is not a field on Earth: read as {length:.3g} {unit}")
    x, y, z = NT_PER_UNIT[unit] * tesla
    time = stream.time
    compass = LogCompass(number, len(time), rate(time), stream.topic)
    return Magnetometer(compass, time, {"x": x, "y": -y, "z": -z})


def _unit(length: float) -> str:
    """Return the unit in which a median length is one of the Earth's; T where it is, or where none fits."""
    if TESLA[0] <= length <= TESLA[1]:
        return "T"
    return next((unit for unit in FIELD_UNITS if EARTH[0] <= NT_PER_UNIT[unit] * length < EARTH[1]), "T")


def _telemetry(streams: Sequence[_Stream]) -> Iterator[Series]:
    seen: dict[str, int] = {}
    for stream in streams:
        if stream.kind is not MESSAGE_KINDS[MAGNETIC_FIELD]:
            number = seen.setdefault(stream.kind.name, 0)
            seen[stream.kind.name] += 1
            for column, unit, values in stream.kind.columns(stream.topic, number, stream.values):
                yield stream.time, column, unit, values


class _Bag(NamedTuple):
    """An open bag of any kind."""

    connections: Sequence[Any]
    messages: Any
    deserialize: Any
    ros2: bool


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    """Open a bag; a single file of a ROS 2 bag lacks the folder that rosbags expects."""
    default = get_typestore(Stores.LATEST)
    storage = STORAGES.get(path.suffix.lower()) if path.is_file() else None
    if storage is None:
        with AnyReader([path], default_typestore=default) as reader:
            yield _Bag(reader.connections, reader.messages, reader.deserialize, reader.is2)
        return
    file: Any = storage(path)
    with ExitStack() as stack:
        file.open()
        stack.callback(file.close)
        own = {}
        for one in file.connections:
            if one.msgdef.format == MessageDefinitionFormat.MSG:
                own.update(get_types_from_msg(one.msgdef.data, one.msgtype))
        store = get_typestore(Stores.EMPTY)
        store.register({**default.fielddefs, **own})
        yield _Bag(file.connections, file.messages, store.deserialize_cdr, ros2=True)


def _streams(bag: _Bag) -> tuple[list[_Stream], int]:
    """Return the topics that are read, and how many messages could not be."""
    wanted = [one for one in bag.connections if _short(one.msgtype) in MESSAGE_KINDS]
    raw: dict[str, tuple[Any, list[int], list[bytes]]] = {one.topic: (one, [], []) for one in wanted}
    for connection, stamp, data in bag.messages(connections=wanted) if wanted else ():
        _, stamps, messages = raw[connection.topic]
        stamps.append(stamp)
        messages.append(data)
    found, lost = [], 0
    for topic, (connection, stamps, messages) in raw.items():
        if messages:
            kind = MESSAGE_KINDS[_short(connection.msgtype)]
            good, values = _decoded(bag, connection.msgtype, kind, messages)
            lost += len(messages) - len(good)
            if len(good):
                when = _times(
                    kind, np.array(stamps, dtype=np.float64)[good] * 1e-9, [messages[k] for k in good]
                )
                found.append(_Stream(topic, kind, when, values))
    return found, lost


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _times(kind: MessageKind, recorded: FloatArray, messages: Sequence[bytes]) -> FloatArray:
    """Return the stamps of the headers, s; the recorder's without a header, or where it is empty."""
    if not kind.header:
        return recorded
    stamps = np.frombuffer(b"".join(one[: ROS_STAMP.itemsize] for one in messages), ROS_STAMP)
    header = stamps["s"] + stamps["ns"] * 1e-9
    return np.where(header > 0, header, recorded)


def _decoded(
    bag: _Bag, name: str, kind: MessageKind, messages: Sequence[bytes]
) -> tuple[Sequence[int], dict[str, FloatArray]]:
    """Return which messages could be read, and their values (n,) by name."""
    if (table := _doubles(bag, name, kind, messages)) is not None:
        return range(len(messages)), table
    rows, good = [], []
    for k, data in enumerate(messages):
        try:
            rows.append(kind.row(bag.deserialize(data, name)))
            good.append(k)
        except (*ROSBAG_ERRORS, ValueError, IndexError, AssertionError):  # a damaged message
            continue
    names = dict.fromkeys(name for row in rows for name in row)
    return good, {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}


def _doubles(
    bag: _Bag, name: str, kind: MessageKind, messages: Sequence[bytes]
) -> dict[str, FloatArray] | None:
    """Return the values of messages that end with doubles only, read at once; None where they are not such.

    What stands before them is of any length (the frame's name). The first and the last message as rosbags
    reads them prove the layout.
    """
    size = 8 * kind.doubles
    if not kind.doubles or any(len(one) < size + ROS_STAMP.itemsize for one in messages):
        return None
    if bag.ros2 and any(one[:2] != LITTLE for one in messages):
        return None
    table = np.frombuffer(b"".join(one[-size:] for one in messages), "<f8").reshape(-1, kind.doubles)
    for k in (0, -1):
        row = kind.row(bag.deserialize(messages[k], name))
        if not np.array_equal(list(row.values()), table[k, : len(row)], equal_nan=True):
            return None
    return {key: table[:, k] for k, key in enumerate(row)}
