"""Write small logs in third-party formats, of a vehicle that turns through all attitudes."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from log_files import Log, Output, segment, ulog_of
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.field.igrf import igrf

T0 = 1_700_000_000
PLACE = 45.0, -63.0
N = 240
K = np.arange(N)
ANGLES = np.column_stack([40.0 * np.sin(K / 9.0), 35.0 * np.sin(K / 14.0), 6.0 * K % 360.0])
"""Roll, pitch and heading of each sample, deg."""
HERE = (PLACE[1], PLACE[0], 0.0, float(T0))
BODY = Rotation.from_euler("ZYX", ANGLES[:, ::-1], degrees=True)
NED = np.asarray(igrf(*(np.array([one]) for one in HERE))).ravel()
FIELD = float(np.linalg.norm(NED))
"""Total field that a corrected log must show, nT."""
STERN = 2.0 * (K // 40 % 3)
"""Position of a mass that is constant in each of six legs, mm."""
CURRENT = 10.0 * (K // 30 % 2)
"""Current of the motors, A."""


def sensor(*, mass: bool = False, motors: bool = False) -> FloatArray:
    """Return readings (n, 3) in nT of field, hard iron, the chosen disturbances and 5 nT of noise."""
    noise = np.random.default_rng(3).normal(0.0, 5.0, (N, 3))
    field = BODY.inv().apply(NED) + np.array([900.0, -1400.0, 600.0]) + noise
    if mass:
        field = field + STERN[:, None] * np.array([250.0, -40.0, 90.0])
    if motors:
        field = field + CURRENT[:, None] * np.array([120.0, 30.0, -60.0])
    return np.asarray(field)


def engineer(path: Path) -> None:
    """Write a German spreadsheet: semicolons, decimal commas, microtesla, and the day before the month."""
    rows = ["when;F1;F2;F3;stern position [mm];pump;caesium;lock;lat;lon;roll;pitch;yaw"]
    for k, field in enumerate(sensor(mass=True) / 1e3):
        when = datetime.fromtimestamp(T0 + k, UTC).strftime("%d.%m.%Y %H:%M:%S")
        numbers = (*field, STERN[k], 3.0, FIELD if k % 5 else 0.0, float(k % 5 > 0), *PLACE, *ANGLES[k])
        rows.append(";".join([when, *(f"{x:.5f}".replace(".", ",") for x in numbers)]))
    path.write_text("\n".join(rows) + "\n", encoding="cp1252")


def ardupilot(path: Path) -> None:
    """Write a copter's ``.BIN`` with two compasses and a battery."""
    log = Log()
    milligauss = np.rint(sensor(motors=True) / 100.0).astype(int)
    for k, field in enumerate(milligauss):
        us = 5_000_000 + k * 100_000
        if k % 5 == 0:
            log.fix(us, T0 + us * 1e-6)
        roll, pitch, yaw = ANGLES[k]
        log.write_message("ATT", us, 0, roll, 0, pitch, 0, yaw, 0, 0, 3)
        log.write_message("BAT", us, 0, 16.0, CURRENT[k])
        log.mag(us, 0, field.tolist())
        log.mag(us, 1, (field + 150).tolist())
    path.write_bytes(log.data)


def pixhawk(path: Path) -> None:
    """Write a ``.ulg`` with a compass, attitude and GPS."""
    topics = {
        "sensor_mag": ("uint64_t timestamp;uint32_t device_id;float x;float y;float z;", "<QI3f"),
        "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
        "sensor_gps": (
            (
                "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;"
                "double longitude_deg;uint8_t fix_type;"
            ),
            "<QQ2dB",
        ),
    }
    texts: Output = []
    for k, field in enumerate(sensor() / 1e5):
        us = 1_000_000 + k * 100_000
        texts.append(("sensor_gps", 0, (us, T0 * 1_000_000 + us, *PLACE, 3)))
        texts.append(("vehicle_attitude", 0, (us, *BODY[k].as_quat()[[3, 0, 1, 2]])))
        texts.append(("sensor_mag", 0, (us, 4711, *field)))
    path.write_bytes(ulog_of(topics, {}, texts))


def bag(path: Path) -> None:
    """Write a ROS 2 bag with ``MagneticField`` (forward, left, up), ``Imu`` and ``NavSatFix`` messages."""
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - an extra of the project
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: Any = store.types
    vector, nine = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    flip, swap = np.diag([1.0, -1.0, -1.0]), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: dict[str, Any] = {}

        def write_message(topic: str, kind: str, k: int, **values: Any) -> None:
            kind = f"sensor_msgs/msg/{kind}"
            stamp = types["builtin_interfaces/msg/Time"](sec=T0 + k // 10, nanosec=k % 10 * 100_000_000)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_cdr(types[kind](header=header, **values), kind)
            writer.write(topics[topic], (T0 * 10 + k) * 100_000_000, data)

        status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
        for k, field in enumerate(sensor() * 1e-9):
            turned = Rotation.from_matrix(swap @ BODY[k].as_matrix() @ flip).as_quat()
            write_message(
                "/imu", "Imu", k, orientation=types["geometry_msgs/msg/Quaternion"](*turned),
                orientation_covariance=nine,
                angular_velocity=vector(0, 0, 0), angular_velocity_covariance=nine,
                linear_acceleration=vector(0, 0, 9.8), linear_acceleration_covariance=nine,
            )  # fmt: skip
            write_message(
                "/gps", "NavSatFix", k, status=status, latitude=PLACE[0], longitude=PLACE[1], altitude=0.0,
                position_covariance=nine, position_covariance_type=0,
            )  # fmt: skip
            write_message(
                "/mag",
                "MagneticField",
                k,
                magnetic_field=vector(*(flip @ field)),
                magnetic_field_covariance=nine,
            )


def slocum(folder: Path) -> None:
    """Write two segments of a Slocum, each as a flight and a science file."""
    for number in range(2):
        k = np.arange(60.0)
        time = T0 + 1000.0 * number + 4.0 * k
        flight = {
            "m_present_time": time,
            "m_depth": 40.0 * np.sin(k / 19.0) ** 2,
            "m_battpos": 0.3 * np.sign(np.sin(k / 19.0)),
            "m_ballast_pumped": 200.0 * np.sign(np.cos(k / 19.0)),
            "m_pitch": 0.4 * np.sin(k / 9.0),
            "m_roll": 0.02 * np.cos(k),
            "m_heading": k % 6.0,
            "m_lat": 4500.0 + 0.01 * k,
            "m_lon": -6300.0 + 0.01 * k,
        }
        science = {"sci_m_present_time": time + 1.0, "sci_water_temp": 9.0 + 0.01 * k}
        segment(folder / f"unit_{number}.dbd", flight)
        segment(folder / f"unit_{number}.ebd", science)
