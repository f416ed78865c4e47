"""Read robots' logs through rosbags: ROS 1 (``.bag``), ROS 2 (a folder with ``metadata.yaml``) and MCAP.

Each row is a ``sensor_msgs/MagneticField`` (tesla). ROS and mavros use forward-left-up axes in the body
(FLU) and east-north-up in the world (ENU). The reader converts both to forward-right-down (FRD) and
north-east-down (NED). An orientation gives a heading only if its world frame is known: for an ``Imu`` (REP
145: ENU), and for an odometry in the frame ``map``, ``earth``, ``utm`` or ``enu``. The frame ``odom`` starts
at an arbitrary heading. Times come from the message's header, else from the recorder.

Many drivers publish gauss or microtesla instead of tesla. The reader recognises this by the field's
magnitude, since the Earth's varies by less than a factor of ten. It converts the field and adds a note.

References
----------
ROS REP 103, 105 and 145, https://www.ros.org/reps/
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.compasses import BootRun, Magnetometer, Series, pieces, sampled
from magbridge.logs.deployment import NOTES, noted
from magbridge.logs.fields import field_maps, fields_of

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
    from magbridge.logs.mapping import Options

STORAGES = {".mcap": McapReader, ".db3": Sqlite3Reader}
"""Suffix of a single file of a ROS 2 bag, outside a bag's folder -> its reader."""
ROSBAG_ERRORS = (AnyReaderError, ReaderError, SerdeError, TypesysError, sqlite3.Error)
ROS_STAMP = np.dtype([("", "V4"), ("s", "<i4"), ("ns", "<u4")])
"""Layout of the start of a message with a header: 4 bytes of sequence (ROS 1) or encapsulation, stamp."""
LITTLE = b"\x00\x01"
MIN_REAL_TIME_S = 315_532_800.0
"""Earliest stamp of a real recording, s since 1970; the stamps of a simulation begin at 0."""
EARTH = 15e3, 150e3
"""Range of a reading's median magnitude, nT: it spans a factor of ten, so that only one unit fits."""
TESLA = 1e-6, 1e-2
"""Range of the median magnitude in which a field is accepted as tesla, T."""
FIELD_UNITS = ("G", "uT", "mG", "mT", "nT")


class _Stream(NamedTuple):
    """Messages of one topic: times (n,), s, and values (n,) by name."""

    topic: str
    kind: MessageKind
    time: FloatArray
    values: dict[str, FloatArray]


def chunks(path: Path, rows: int, options: Options | None = None) -> Iterator[xr.Dataset]:
    """Yield the bag in pieces of at most `rows` rows; all values that are read are in memory."""
    try:
        with _opened(path) as bag:
            streams, lost = _streams(bag)
    except ROSBAG_ERRORS as error:
        raise FormatError(path, f"expected a ROS bag: {error}") from None
    except (OSError, EOFError, KeyError, IndexError, ValueError, AssertionError) as error:
        # rosbags raises these if the file, not a message, is damaged
        reason = str(error) or type(error).__name__
        raise FormatError(path, f"expected a ROS bag; it is damaged: {reason}") from None
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
    unit = "T"
    if not TESLA[0] <= length <= TESLA[1]:
        fitting = (one for one in FIELD_UNITS if EARTH[0] <= NT_PER_UNIT[one] * length < EARTH[1])
        unit = next(fitting, "T")
    if unit != "T":
        notes.append(f"{stream.topic}: {length:.3g} T is not a field on Earth: read as {length:.3g} {unit}")
    x, y, z = NT_PER_UNIT[unit] * tesla
    return sampled(number, stream.time, np.stack([x, -y, -z]), id=stream.topic)


def _telemetry(streams: Sequence[_Stream]) -> Iterator[Series]:
    seen: dict[str, int] = {}
    for stream in streams:
        if stream.kind is not MESSAGE_KINDS[MAGNETIC_FIELD]:
            number = seen.setdefault(stream.kind.name, 0)
            seen[stream.kind.name] += 1
            for column, unit, values in stream.kind.columns(stream.topic, number, stream.values):
                yield stream.time, column, unit, values


class _Bag(NamedTuple):
    """Open bag of ROS 1 or ROS 2: its connections, and the functions that read its messages."""

    connections: Sequence[Any]
    messages: Any
    deserialize: Any
    ros2: bool


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    """Open a bag, or a single file of a ROS 2 bag, for which rosbags expects a folder."""
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
    """Return the messages of each topic that is read, and the number of unreadable messages."""
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
                recorded = np.array(stamps, dtype=np.float64)[good] * 1e-9
                when = _times(kind, recorded, [messages[k] for k in good])
                found.append(_Stream(topic, kind, when, values))
    return found, lost


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _times(kind: MessageKind, recorded: FloatArray, messages: Sequence[bytes]) -> FloatArray:
    """Return the times (n,), s, of the headers, or of the recorder if a header is missing or empty."""
    if not kind.header:
        return recorded
    stamps = np.frombuffer(b"".join(one[: ROS_STAMP.itemsize] for one in messages), ROS_STAMP)
    header = stamps["s"] + stamps["ns"] * 1e-9
    return np.where(header > 0, header, recorded)


def _decoded(
    bag: _Bag, name: str, kind: MessageKind, messages: Sequence[bytes]
) -> tuple[Sequence[int], dict[str, FloatArray]]:
    """Return the indices of the readable messages, and their values (n,) by name."""
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
    """Return the values (n,) by name of messages that end with float64 numbers; None for other messages.

    The bytes before these numbers vary in length (name of the frame). The first and the last message, as
    rosbags reads them, verify the layout.
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


CURRENT_NOTE = "BatteryState.current counted positive when discharging"
FRAMES_HISTORY = f"ROS frames turned: ENU to NED, FLU to FRD; {CURRENT_NOTE}"
MAGNETIC_FIELD = "sensor_msgs/MagneticField"
FIX = "sensor_msgs/NavSatFix"
TOPIC = "@"
"""Placeholder for the name of the topic in the name of a column."""
ROS_FIELDS = field_maps("ros")
ABSOLUTE = ("map", "earth", "utm", "enu")
"""Names of frames whose x axis points east."""

Values = Mapping[str, FloatArray]
Columns = Iterator[tuple[str, str, FloatArray]]


class MessageKind(NamedTuple):
    """Type of message, with the functions that read its values and form its columns."""

    name: str
    """Name of the type."""
    row: Callable[[Any], dict[str, float]]
    """Function that returns the values of a message by name."""
    columns: Callable[[str, int, Values], Columns]
    """Function of the topic's name, its number among topics of this type (from 0), and all values by name. It
    yields column, unit and values (n,). If several topics have one column, the first is used."""
    header: bool = True
    """True if the message begins with a ``std_msgs/Header``."""
    doubles: int = 0
    """Number of float64 at the end of the message, first the values of `row`; 0 for another layout."""


def _name(topic: str, *more: str) -> str:
    return re.sub(r"\W+", "_", "_".join([topic.strip("/"), *more])).strip("_").lower()


def _angles(v: Values) -> Columns:
    """Yield roll, pitch and heading, deg, from the quaternion of FLU to ENU; nothing if it is not known."""
    x, y, z, w = (v[f"q{axis}"] for axis in "xyzw")
    norm = x * x + y * y + z * z + w * w
    known = (np.abs(norm - 1) < 0.1) & (v["unknown"] != -1)  # the first covariance is -1: no orientation
    if not known.any() or (np.abs(w) == 1.0).all():  # a constant identity is not an attitude
        return
    x, y, z, w = (np.where(known, one, np.nan) for one in (x, y, z, w))
    # elements of the rotation from FLU to ENU; FRD reverses y and z, NED swaps x and y and reverses z
    down_x, down_y, down_z = -2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    east_x, north_x = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    yield "roll", "deg", np.degrees(np.arctan2(down_y, down_z))
    yield "pitch", "deg", np.degrees(-np.arcsin(np.clip(down_x, -1, 1)))
    yield "heading", "deg", np.degrees(np.arctan2(east_x, north_x)) % 360.0


def _axes(prefix: str, vector: Any, axes: str = "xyz") -> dict[str, float]:
    """Return the components of a vector or a quaternion by name: `prefix` and axis."""
    return {f"{prefix}{axis}": getattr(vector, axis) for axis in axes}


def _odometry_row(m: Any) -> dict[str, float]:
    pose, linear = m.pose.pose, m.twist.twist.linear
    absolute = float(m.header.frame_id.rpartition("/")[2].lower() in ABSOLUTE)
    vectors = _axes("", pose.position) | _axes("q", pose.orientation, "xyzw") | _axes("u", linear)
    return {**vectors, "absolute": absolute, "unknown": 0.0}


def _odometry(topic: str, number: int, v: Values) -> Columns:
    if number or not v["absolute"].all():
        for axis in "xyz":
            yield _name(topic, axis), "m", v[axis]
        return
    yield "local_north", "m", v["y"]
    yield "local_east", "m", v["x"]
    x, y, z, w = (v[f"q{axis}"] for axis in "xyzw")
    forward, left, up = (v[f"u{axis}"] for axis in "xyz")
    east = (1 - 2 * (y * y + z * z)) * forward + 2 * (x * y - w * z) * left + 2 * (x * z + w * y) * up
    north = 2 * (x * y + w * z) * forward + (1 - 2 * (x * x + z * z)) * left + 2 * (y * z - w * x) * up
    yield "velocity_north", "m/s", north
    yield "velocity_east", "m/s", east
    yield from _angles(v)


def _fields(name: str, *, header: bool = True) -> MessageKind:
    """Return the type of message `name`, whose fields and columns :data:`ROS_FIELDS` lists."""
    fields = ROS_FIELDS[name]

    def row(message: Any) -> dict[str, float]:
        known = name != FIX or message.status.status >= 0
        return {one.field: float(getattr(message, one.field)) for one in fields} if known else {}

    def columns(topic: str, number: int, v: Values) -> Columns:
        for column, unit, values in fields_of(fields, v, number):
            yield column.replace(TOPIC, _name(topic)), unit, values

    return MessageKind(name, row, columns, header)


def _temperature(topic: str, _: int, v: Values) -> Columns:
    name = _name(topic)
    yield name if "temp" in name else f"{name}_temperature", "degC", v["temperature"]


MESSAGE_KINDS = {
    kind.name: kind
    for kind in (
        MessageKind(MAGNETIC_FIELD, lambda m: _axes("", m.magnetic_field), lambda *_: iter(()), doubles=12),
        MessageKind(
            "sensor_msgs/Imu",
            lambda m: _axes("q", m.orientation, "xyzw") | {"unknown": float(m.orientation_covariance[0])},
            lambda _, __, v: _angles(v),
            doubles=37,
        ),
        MessageKind("nav_msgs/Odometry", _odometry_row, _odometry),
        MessageKind(
            "sensor_msgs/JointState",
            lambda m: dict(zip(m.name, map(float, m.position), strict=False)),
            # rad, or m for a sliding joint: the message does not state the unit
            lambda _, __, v: ((_name(name), "1", values) for name, values in v.items()),
        ),
        MessageKind("sensor_msgs/Temperature", lambda m: {"temperature": float(m.temperature)}, _temperature),
        MessageKind(
            "mavros_msgs/RCOut",
            lambda m: {f"servo{k}": float(value) for k, value in enumerate(m.channels, 1)},
            lambda _, __, v: ((name, "us", values) for name, values in v.items() if np.any(values)),
        ),
        *(_fields(name, header=not name.startswith("std_msgs/")) for name in ROS_FIELDS),
    )
}
"""Name of each type of message that is read -> the type. mavros publishes them; only ``RCOut`` is its own."""
