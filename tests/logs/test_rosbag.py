"""Test ROS bags: written by rosbags, read in magbridge's axes, and compared with rosbags' reader."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.compasses import compasses_in
from magbridge.logs.deployment import noted

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

T0 = 1_700_000_000
ANGLES = np.random.default_rng(0).uniform([-180, -89, 0], [180, 89, 360], (40, 3))
FIELD = np.random.default_rng(1).normal(0, 3e-5, (40, 3))
"""Field in ROS' axes, T."""
RC_OUT = "std_msgs/Header header\nuint16[] channels\n"


def bag(
    path: Path,
    kind: str = "sqlite3",
    scale: float = 1.0,
    frame: str = "map",
    more: Callable[..., None] | None = None,
) -> Path:
    """Write a bag: ``ros1``, ``sqlite3`` or ``mcap``."""
    one = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(RC_OUT, "mavros_msgs/msg/RCOut"))
    types: Any = store.types
    writer: Any = (
        Writer1(path)
        if one
        else Writer2(path, version=9, storage_plugin=getattr(StoragePlugin, kind.upper()))
    )
    serialize = store.serialize_ros1 if one else store.serialize_cdr

    def header(k: int, name: str) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=T0 + k // 10, nanosec=k % 10 * 100_000_000)
        extra = {"seq": k} if one else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=name, **extra)

    vector, nine = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    with writer:
        topics: dict[str, Any] = {}

        def write_message(topic: str, message: str, k: int, /, **fields: Any) -> None:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message, typestore=store)
            writer.write(
                topics[topic],
                (T0 * 10 + k) * 100_000_000 + 10**6,
                serialize(types[message](**fields), message),
            )

        for k, (angles, field) in enumerate(zip(ANGLES, FIELD, strict=True)):
            if more is not None:
                more(write_message, types, header, k, frame)
            # from FRD to NED, turned to FLU and ENU
            turned = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
            enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]) @ turned @ np.diag([1, -1, -1.0])
            q = types["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(enu).as_quat())
            write_message(
                "/imu/data", "sensor_msgs/msg/Imu", k, header=header(k, "imu"), orientation=q,
                orientation_covariance=nine, angular_velocity=vector(1, 2, 3),
                angular_velocity_covariance=nine, linear_acceleration=vector(4, 5, 6),
                linear_acceleration_covariance=nine,
            )  # fmt: skip
            write_message(
                "/joints", "sensor_msgs/msg/JointState", k, header=header(k, ""), name=["arm lift", "grip"],
                position=np.array([0.01 * k, 1.0]), velocity=np.array([]), effort=np.array([]),
            )  # fmt: skip
            write_message(
                "/imu/mag", "sensor_msgs/msg/MagneticField", k, header=header(k, "mag" * (1 + k % 2)),
                magnetic_field=vector(*(scale * field)), magnetic_field_covariance=nine,
            )  # fmt: skip
    return path


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_in_our_frames(kind: str, tmp_path: Path) -> None:
    back = logs.read(bag(tmp_path / ("log.bag" if kind == "ros1" else "log"), kind))
    np.testing.assert_allclose(back["time"], T0 + 0.1 * np.arange(40), rtol=0, atol=1e-6)
    for axis, values in zip("xyz", (1e9 * FIELD * [1, -1, -1]).T, strict=True):
        np.testing.assert_allclose(back[f"mag_{axis}"], values, rtol=1e-12)
    for name, values in zip(("roll", "pitch", "heading"), ANGLES.T, strict=True):
        np.testing.assert_allclose(back[name], values, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(back["arm_lift"], 0.01 * np.arange(40))
    assert "ENU to NED" in back.attrs["history"]
    assert [one.id for one in compasses_in(back)] == ["/imu/mag"]
    assert not noted(back.attrs)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_one_file_of_a_bag(kind: str, tmp_path: Path) -> None:
    """Foxglove's bags are single files without the metadata of a folder."""
    folder = bag(tmp_path / "log", kind)
    (file,) = folder.glob("*.db3" if kind == "sqlite3" else "*.mcap")
    whole = logs.read(folder)
    xr_equal = logs.read(file)
    for name in whole.data_vars:
        np.testing.assert_array_equal(xr_equal[name], whole[name])


@pytest.mark.parametrize(("unit", "per_tesla"), [("G", 1e4), ("uT", 1e6), ("mG", 1e7)])
def test_a_driver_that_does_not_publish_tesla_is_reported(
    unit: str, per_tesla: float, tmp_path: Path
) -> None:
    back = logs.read(bag(tmp_path / "log", scale=per_tesla))
    np.testing.assert_allclose(back["mag_x"], 1e9 * FIELD[:, 0], rtol=1e-9)
    (note,) = noted(back.attrs)
    assert note.endswith(f" {unit}")
    assert "is not a field on Earth" in note
    assert note in back.attrs["history"]
    # a field that no unit makes as strong as the Earth's keeps the message's unit
    back = logs.read(bag(tmp_path / "none", scale=1e12))
    np.testing.assert_allclose(back["mag_x"], 1e21 * FIELD[:, 0], rtol=1e-9)
    assert not noted(back.attrs)


def _odometry(write_message: Any, types: Any, header: Any, k: int, frame: str) -> None:
    """Sail east at 2 m/s, the bow to the east."""
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=0.2 * k, y=5.0, z=-3.0),
        orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    vector = types["geometry_msgs/msg/Vector3"]
    twist = types["geometry_msgs/msg/Twist"](linear=vector(2.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    write_message(
        "/odom", "nav_msgs/msg/Odometry", k, header=header(k, frame), child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def test_an_odometry_of_the_map_is_dead_reckoning(tmp_path: Path) -> None:
    back = logs.read(bag(tmp_path / "log", more=_odometry))
    np.testing.assert_allclose(back["local_east"], 0.2 * np.arange(40))
    np.testing.assert_allclose(back["local_north"], 5.0)
    np.testing.assert_allclose(back["velocity_east"], 2.0)
    np.testing.assert_allclose(back["velocity_north"], 0.0, atol=1e-12)
    # in a frame of its own it is not a position
    back = logs.read(bag(tmp_path / "own", frame="odom", more=_odometry))
    assert "local_east" not in back
    np.testing.assert_allclose(back["odom_x"], 0.2 * np.arange(40))


def _robot(write_message: Any, types: Any, header: Any, k: int, _: str) -> None:
    """Write the topics of a robot with mavros: position fixes with gaps, battery, servos and sensors."""
    status = types["sensor_msgs/msg/NavSatStatus"](status=-1 if k % 4 == 3 else 0, service=1)
    write_message(
        "/mavros/global_position/global", "sensor_msgs/msg/NavSatFix", k, header=header(k, ""), status=status,
        latitude=47.0 + 1e-4 * k, longitude=8.0 - 1e-4 * k, altitude=400.0 + k,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
    battery = {
        field: np.array([], np.float32) if field.startswith("cell_") else
        "" if field in {"location", "serial_number"} else False if field == "present" else 0
        for field in types["sensor_msgs/msg/BatteryState"].__dataclass_fields__
        if field not in {"header", "__msgtype__"} and not field.isupper() and "SUPPLY_" not in field
    }  # fmt: skip
    for number in range(2):
        known = battery | {"voltage": 16.0 - number, "current": -0.5 * k - number}
        write_message(f"/battery{number}", "sensor_msgs/msg/BatteryState", k, header=header(k, ""), **known)
    channels = np.array([1500 + k, 0, 1100], np.uint16)
    write_message("/mavros/rc/out", "mavros_msgs/msg/RCOut", k, header=header(k, ""), channels=channels)
    write_message(
        "/board", "sensor_msgs/msg/Temperature", k, header=header(k, ""), temperature=20.0 + k, variance=0.0
    )
    write_message(
        "/air", "sensor_msgs/msg/FluidPressure", k, header=header(k, ""), fluid_pressure=1e5 + k, variance=0.0
    )
    write_message("/keel/angle", "std_msgs/msg/Float64", k, data=0.1 * k)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_whatever_a_robot_says_is_as_rosbags_reads_it(kind: str, tmp_path: Path) -> None:
    path = bag(tmp_path / ("log.bag" if kind == "ros1" else "log"), kind, more=_robot)
    theirs: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            theirs.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    back = logs.read(path)
    fixes = theirs["/mavros/global_position/global"]
    # the last fix before a row: of every fourth there is none
    last = [fixes[k - (k % 4 == 3)] for k in range(40)]
    expected = {
        "latitude": [one.latitude for one in last],
        "longitude": [one.longitude for one in last],
        "depth": [-one.altitude for one in last],
        "battery_current": [-one.current for one in theirs["/battery0"]],
        "battery_voltage": [one.voltage for one in theirs["/battery0"]],
        "battery2_current": [-one.current for one in theirs["/battery1"]],
        "battery2_voltage": [one.voltage for one in theirs["/battery1"]],
        "servo1": [one.channels[0] for one in theirs["/mavros/rc/out"]],
        "servo3": [one.channels[2] for one in theirs["/mavros/rc/out"]],
        "board_temperature": [one.temperature for one in theirs["/board"]],
        "pressure": [0.01 * one.fluid_pressure for one in theirs["/air"]],
        "arm_lift": [one.position[0] for one in theirs["/joints"]],
        "grip": [one.position[1] for one in theirs["/joints"]],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(back[name], values, rtol=1e-12, err_msg=name)
    # it has no header, and is stamped by the recorder 1 ms later than the row
    np.testing.assert_allclose(back["keel_angle"][1:], 0.1 * np.arange(39), err_msg="keel_angle")
    assert back["battery_current"].attrs["units"] == "A"
    known = {"mag_x", "mag_y", "mag_z", "roll", "pitch", "heading", "keel_angle", *expected}
    assert set(back.data_vars) == known


@pytest.mark.parametrize("covariance", [-1.0, 0.0])
def test_an_imu_that_knows_no_orientation_gives_none(covariance: float, tmp_path: Path) -> None:
    """The first covariance is -1, or the quaternion is always 0 0 0 1, as of drivers without an estimator."""

    def other(write_message: Any, types: Any, header: Any, k: int, _: str) -> None:
        vector, nine = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 9.8), np.zeros(9)
        write_message(
            "/a_raw", "sensor_msgs/msg/Imu", k, header=header(k, "imu"),
            orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=np.array([covariance, *[0.0] * 8]), angular_velocity=vector,
            angular_velocity_covariance=nine, linear_acceleration=vector, linear_acceleration_covariance=nine,
        )  # fmt: skip

    back = logs.read(bag(tmp_path / "log", more=other))
    for name, values in zip(("roll", "pitch", "heading"), ANGLES.T, strict=True):
        np.testing.assert_allclose(back[name], values, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("kept", [0.3, 0.9])
def test_a_bag_that_breaks_off_is_one_line(kept: float, tmp_path: Path) -> None:
    path = bag(tmp_path / "log.bag", "ros1")
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(FormatError, match=r"log\.bag: .*ROS bag"):
        logs.read(path)
