"""Values of ROS messages, turned to the frames of this project.

ROS has x forward, y left, z up in the body (FLU) and east, north, up in the world (ENU); here it is forward,
right, down (FRD) and north, east, down (NED). mavros' topics are in ROS' frames, too. An orientation is used
as a heading only where its world is one: that of an ``Imu`` (REP 145: east-north-up), or of an odometry whose
frame is ``map``, ``earth``, ``utm`` or ``enu``; the frame ``odom`` begins wherever the robot looked.

References
----------
ROS REP 103, 105 and 145, https://www.ros.org/reps/
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["FRAMES_HISTORY", "MAGNETIC_FIELD", "MESSAGE_KINDS", "MessageKind"]

FRAMES_HISTORY = (
    "ROS frames turned: ENU to NED, FLU to FRD; BatteryState.current counted positive when discharging"
)
MAGNETIC_FIELD = "sensor_msgs/MagneticField"
ABSOLUTE = ("map", "earth", "utm", "enu")
"""Names of frames whose x axis points east."""

Values = Mapping[str, FloatArray]
Columns = Iterator[tuple[str, str, FloatArray]]


class MessageKind(NamedTuple):
    """A type of message."""

    name: str
    """Name of the type."""
    row: Callable[[Any], dict[str, float]]
    """Returns the values of a message by name."""
    columns: Callable[[str, int, Values], Columns]
    """Returns column, unit and values of the topic's name, its number among those of this type (from 0), and
    the values of all messages. The first of several topics with a column is taken."""
    header: bool = True
    """It begins with a ``std_msgs/Header``."""
    doubles: int = 0
    """How many float64 the message ends with, of which the first are those of `row`; 0 where it does not."""


def _name(topic: str, *more: str) -> str:
    return re.sub(r"\W+", "_", "_".join([topic.strip("/"), *more])).strip("_").lower()


def _numbered(number: int) -> str:
    return str(number + 1) if number else ""


def _angles(v: Values) -> Columns:
    """Yield roll, pitch and heading (deg) of the quaternion that turns FLU into ENU, if it is ever known."""
    x, y, z, w = (v[f"q{axis}"] for axis in "xyzw")
    norm = x * x + y * y + z * z + w * w
    known = (np.abs(norm - 1) < 0.1) & (v["unknown"] != -1)  # the first covariance is -1: no orientation
    if not known.any() or (np.abs(w) == 1.0).all():  # a constant identity is not an attitude
        return
    x, y, z, w = (np.where(known, one, np.nan) for one in (x, y, z, w))
    # of the rotation from FLU to ENU; FRD has the opposite y and z, NED swaps x and y and has the opposite z
    down_x, down_y, down_z = -2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    east_x, north_x = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    yield "roll", "deg", np.degrees(np.arctan2(down_y, down_z))
    yield "pitch", "deg", np.degrees(-np.arcsin(np.clip(down_x, -1, 1)))
    yield "heading", "deg", np.degrees(np.arctan2(east_x, north_x)) % 360.0


def _axes(prefix: str, vector: Any, axes: str = "xyz") -> dict[str, float]:
    """Return the components of a vector or a quaternion by name."""
    return {f"{prefix}{axis}": getattr(vector, axis) for axis in axes}


def _imu_row(m: Any) -> dict[str, float]:
    return {**_axes("q", m.orientation, "xyzw"), "unknown": float(m.orientation_covariance[0])}


def _fix_row(m: Any) -> dict[str, float]:
    return {"lat": m.latitude, "lon": m.longitude, "alt": m.altitude} if m.status.status >= 0 else {}


def _fix(_: str, __: int, v: Values) -> Columns:
    if v:
        yield "latitude", "deg", v["lat"]
        yield "longitude", "deg", v["lon"]
        yield "altitude", "m", v["alt"]


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


def _battery(_: str, number: int, v: Values) -> Columns:
    yield f"battery{_numbered(number)}_current", "A", -v["current"]  # ROS: negative when discharging
    yield f"battery{_numbered(number)}_voltage", "V", v["voltage"]


def _joints(_: str, __: int, v: Values) -> Columns:
    for name, values in v.items():
        yield _name(name), "1", values  # rad, or m of a joint that slides: the message does not say


def _channels(_: str, __: int, v: Values) -> Columns:
    for name, values in v.items():
        if np.any(values):
            yield name, "us", values


def _by_topic(unit: str, field: str = "data") -> Callable[[str, int, Values], Columns]:
    def columns(topic: str, _: int, v: Values) -> Columns:
        yield _name(topic), unit, v[field]

    return columns


def _temperature(topic: str, _: int, v: Values) -> Columns:
    name = _name(topic)
    yield name if "temp" in name else f"{name}_temperature", "degC", v["temperature"]


def _pressure(_: str, number: int, v: Values) -> Columns:
    yield f"pressure{_numbered(number)}", "hPa", 0.01 * v["pressure"]


def _nothing(_: str, __: int, ___: Values) -> Columns:
    yield from ()


MESSAGE_KINDS = {
    kind.name: kind
    for kind in (
        MessageKind(MAGNETIC_FIELD, lambda m: _axes("", m.magnetic_field), _nothing, doubles=12),
        MessageKind("sensor_msgs/Imu", _imu_row, lambda _, __, v: _angles(v), doubles=37),
        MessageKind("sensor_msgs/NavSatFix", _fix_row, _fix),
        MessageKind("nav_msgs/Odometry", _odometry_row, _odometry),
        MessageKind(
            "sensor_msgs/BatteryState",
            lambda m: {"current": float(m.current), "voltage": float(m.voltage)},
            _battery,
        ),
        MessageKind(
            "sensor_msgs/JointState",
            lambda m: dict(zip(m.name, map(float, m.position), strict=False)),
            _joints,
        ),
        MessageKind("sensor_msgs/Temperature", lambda m: {"temperature": float(m.temperature)}, _temperature),
        MessageKind("sensor_msgs/FluidPressure", lambda m: {"pressure": float(m.fluid_pressure)}, _pressure),
        MessageKind(
            "mavros_msgs/RCOut",
            lambda m: {f"servo{k}": float(value) for k, value in enumerate(m.channels, 1)},
            _channels,
        ),
        *(
            MessageKind(f"std_msgs/{name}", lambda m: {"data": float(m.data)}, _by_topic("1"), header=False)
            for name in ("Float32", "Float64")
        ),
    )
}
"""Type to the values that are read. mavros' other topics are of these types, except its outputs to the
servos."""
