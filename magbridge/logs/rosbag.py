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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import NT_PER_UNIT, YEAR_1980
from magbridge.errors import FormatError, MissingExtra
from magbridge.logs.compasses import BootRun, Magnetometer, Series, pieces, sampled
from magbridge.logs.fields import euler_deg, field_maps, fields_of
from magbridge.logs.mapping import Options

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

STORAGES = {".mcap": McapReader, ".db3": Sqlite3Reader}
"""Suffix of a single file of a ROS 2 bag, outside a bag's folder -> its reader."""
ROSBAG_ERRORS = (AnyReaderError, ReaderError, SerdeError, TypesysError, sqlite3.Error)
ROS_STAMP = np.dtype([("", "V4"), ("s", "<i4"), ("ns", "<u4")])
"""Layout of the start of a message with a header: 4 bytes of sequence (ROS 1) or encapsulation, stamp."""
LITTLE = b"\x00\x01"
EARTH = 15e3, 150e3
"""Range of a reading's median magnitude, nT: it spans a factor of ten, so that only one unit fits."""
TESLA = 1e-6, 1e-2
"""Range of the median magnitude in which a field is accepted as tesla, T."""
FIELD_UNITS = ("G", "uT", "mG", "mT", "nT")
MAGNETIC_FIELD = "sensor_msgs/MagneticField"


class _Stream(NamedTuple):
    """Messages of one topic: times (n,), s, and values (n,) by name."""

    topic: str
    kind: str
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
    fields = [stream for stream in streams if stream.kind == MAGNETIC_FIELD]
    if not fields:
        topics = " ".join(stream.topic for stream in streams) or "nothing that is read"
        raise FormatError(path, f"expected sensor_msgs/MagneticField; there is: {topics}")
    notes: list[str] = []
    mags = [_magnetometer(number, stream, notes) for number, stream in enumerate(fields)]
    boot = float(np.median(mags[0].time)) < YEAR_1980  # the stamps of a simulation begin at 0
    run = BootRun(mags, _telemetry(streams), None if boot else 0.0)
    attrs = {"values_dropped": lost, "history": "\n".join([FRAMES_HISTORY, *notes])}
    yield from pieces(path, rows, [run], attrs, notes, options.compass if options else None)


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
        if stream.kind != MAGNETIC_FIELD:
            number = seen.setdefault(stream.kind, 0)
            seen[stream.kind] += 1
            for column, unit, values in _columns(stream.kind, stream.topic, number, stream.values):
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
            kind = _short(connection.msgtype)
            good, values = _decoded(bag, connection.msgtype, kind, messages)
            lost += len(messages) - len(good)
            if len(good):
                recorded = np.array(stamps, dtype=np.float64)[good] * 1e-9
                when = _times(kind, recorded, [messages[k] for k in good])
                found.append(_Stream(topic, kind, when, values))
    return found, lost


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _times(kind: str, recorded: FloatArray, messages: Sequence[bytes]) -> FloatArray:
    """Return the times (n,), s, of the headers, or of the recorder if a header is missing or empty."""
    if kind.startswith("std_msgs/"):
        return recorded
    stamps = np.frombuffer(b"".join(one[: ROS_STAMP.itemsize] for one in messages), ROS_STAMP)
    header = stamps["s"] + stamps["ns"] * 1e-9
    return np.where(header > 0, header, recorded)


def _decoded(
    bag: _Bag, name: str, kind: str, messages: Sequence[bytes]
) -> tuple[Sequence[int], dict[str, FloatArray]]:
    """Return the indices of the readable messages, and their values (n,) by name."""
    if (table := _doubles(bag, name, kind, messages)) is not None:
        return range(len(messages)), table
    rows, good = [], []
    for k, data in enumerate(messages):
        try:
            rows.append(_row(kind, bag.deserialize(data, name)))
            good.append(k)
        except (*ROSBAG_ERRORS, ValueError, IndexError, AssertionError):  # a damaged message
            continue
    names = dict.fromkeys(name for row in rows for name in row)
    return good, {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}


def _doubles(bag: _Bag, name: str, kind: str, messages: Sequence[bytes]) -> dict[str, FloatArray] | None:
    """Return the values (n,) by name of messages that end with float64 numbers; None for other messages.

    The bytes before these numbers vary in length (name of the frame). The first and the last message, as
    rosbags reads them, verify the layout.
    """
    doubles = DOUBLES.get(kind, 0)
    size = 8 * doubles
    if not doubles or any(len(one) < size + ROS_STAMP.itemsize for one in messages):
        return None
    if bag.ros2 and any(one[:2] != LITTLE for one in messages):
        return None
    table = np.frombuffer(b"".join(one[-size:] for one in messages), "<f8").reshape(-1, doubles)
    for k in (0, -1):
        row = _row(kind, bag.deserialize(messages[k], name))
        if not np.array_equal(list(row.values()), table[k, : len(row)], equal_nan=True):
            return None
    return {key: table[:, k] for k, key in enumerate(row)}


CURRENT_NOTE = "BatteryState.current counted positive when discharging"
FRAMES_HISTORY = f"ROS frames turned: ENU to NED, FLU to FRD; {CURRENT_NOTE}"
FIX = "sensor_msgs/NavSatFix"
IMU, ODOMETRY, JOINTS = "sensor_msgs/Imu", "nav_msgs/Odometry", "sensor_msgs/JointState"
SERVOS = "mavros_msgs/RCOut"
TOPIC = "@"
"""Placeholder for the name of the topic in the name of a column."""
ROS_FIELDS = field_maps("ros")
MESSAGE_KINDS = (MAGNETIC_FIELD, IMU, ODOMETRY, JOINTS, SERVOS, *ROS_FIELDS)
"""Types of messages that are read. mavros publishes them; only ``RCOut`` is its own."""
DOUBLES = {MAGNETIC_FIELD: 12, IMU: 37}
"""Type of message -> number of float64 at its end, of which the first are the values of :func:`_row`."""
ABSOLUTE = ("map", "earth", "utm", "enu")
"""Names of frames whose x axis points east."""

Values = Mapping[str, FloatArray]
Columns = Iterator[tuple[str, str, FloatArray]]


def _row(kind: str, m: Any) -> dict[str, float]:
    """Return the values of a message of type `kind` by name; empty if it has none."""
    if kind == MAGNETIC_FIELD:
        return _axes("", m.magnetic_field)
    if kind == IMU:
        return _axes("q", m.orientation, "xyzw") | {"unknown": float(m.orientation_covariance[0])}
    if kind == ODOMETRY:
        pose, absolute = m.pose.pose, m.header.frame_id.rpartition("/")[2].lower() in ABSOLUTE
        vectors = _axes("", pose.position) | _axes("q", pose.orientation, "xyzw")
        return vectors | _axes("u", m.twist.twist.linear) | {"absolute": float(absolute), "unknown": 0.0}
    if kind == JOINTS:
        return dict(zip(m.name, map(float, m.position), strict=False))
    if kind == SERVOS:
        return {f"servo{k}": float(value) for k, value in enumerate(m.channels, 1)}
    known = kind != FIX or m.status.status >= 0
    return {one.field: float(getattr(m, one.field)) for one in ROS_FIELDS[kind]} if known else {}


def _axes(prefix: str, vector: Any, axes: str = "xyz") -> dict[str, float]:
    """Return the components of a vector or a quaternion by name: `prefix` and axis."""
    return {f"{prefix}{axis}": getattr(vector, axis) for axis in axes}


def _columns(kind: str, topic: str, number: int, v: Values) -> Columns:
    """Yield column, unit and values (n,) of a topic, the topic `number` (from 0) of its type.

    If several topics have one column, the first is used.
    """
    if kind == IMU:
        yield from _angles(v)
    elif kind == ODOMETRY:
        yield from _odometry(topic, number, v)
    elif kind == JOINTS:  # rad, or m for a sliding joint: the message does not state the unit
        yield from ((_name(name), "1", values) for name, values in v.items())
    elif kind == SERVOS:
        yield from ((name, "us", values) for name, values in v.items() if np.any(values))
    else:
        name = _name(topic)
        for column, unit, values in fields_of(ROS_FIELDS[kind], v, number):
            called = column.removesuffix("_temperature") if "temp" in name else column
            yield called.replace(TOPIC, name), unit, values


def _name(topic: str, *more: str) -> str:
    return re.sub(r"\W+", "_", "_".join([topic.strip("/"), *more])).strip("_").lower()


def _angles(v: Values) -> Columns:
    """Yield roll, pitch and heading, deg, from the quaternion of FLU to ENU; nothing if it is not known."""
    w, x, y, z = (v[f"q{axis}"] for axis in "wxyz")
    norm = x * x + y * y + z * z + w * w
    known = (np.abs(norm - 1) < 0.1) & (v["unknown"] != -1)  # the first covariance is -1: no orientation
    if not known.any() or (np.abs(w) == 1.0).all():  # a constant identity is not an attitude
        return
    roll, pitch, yaw = euler_deg(*(np.where(known, one, np.nan) for one in (w, x, y, z)))
    # FRD reverses y and z, so that pitch is nose up; NED swaps x and y, so that yaw counts from north
    yield "roll", "deg", roll
    yield "pitch", "deg", -pitch
    yield "heading", "deg", (90.0 - yaw) % 360.0


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
