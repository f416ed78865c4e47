"""A station's log: blocks of any size give the same columns; the senders are separated."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from magbridge import logs
from magbridge.logs import telemetry
from magbridge.logs.compasses import compasses_in
from magbridge.logs.deployment import noted
from magbridge.logs.mapping import Options
from magbridge.mavlink import Codec, pack_record
from magbridge.mavlink.tlog import blocks

T0, S = 1_700_000_000_000_000, 1_000_000


class Log:
    """A log in the making; times in s after its start."""

    def __init__(self) -> None:
        self.data = b""
        self.codecs: dict[int, Codec] = {}

    def write_message(self, t: float, message: str, /, component: int = 1, **fields: Any) -> None:
        frame = self.codecs.setdefault(component, Codec(1, component)).pack(message, **fields)
        self.data += pack_record(T0 + round(t * S), 0, frame)

    def write(self, tmp_path: Path) -> Path:
        path = tmp_path / "log.tlog"
        path.write_bytes(self.data)
        return path


@pytest.mark.real
@pytest.mark.parametrize("name", ["small.tlog", "damaged.tlog"])
def test_blocks_of_any_size_give_the_same(
    name: str, real_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = real_data / "ardusub" / name
    whole = logs.read(path)
    monkeypatch.setattr(telemetry, "blocks", partial(blocks, block_bytes=5_000))
    xr.testing.assert_identical(whole, logs.read(path))


def test_a_named_value_never_takes_a_column_with_a_source(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "ATTITUDE", yaw=1.0)
        log.write_message(k, "NAMED_VALUE_FLOAT", name="heading", value=7.0)
        log.write_message(k, "NAMED_VALUE_FLOAT", name="mag_x", value=8.0)
        log.write_message(k, "RAW_IMU", xmag=100 + k)
    back = logs.read(log.write(tmp_path))
    np.testing.assert_allclose(back["heading"], np.degrees(1.0), rtol=1e-6)
    np.testing.assert_allclose(back["mag_x"], 100.0 * (100 + np.arange(5)))
    np.testing.assert_allclose(back["named_heading"], 7.0)
    assert any("named_heading" in note for note in noted(back.attrs))


def test_a_named_value_is_the_autopilots_where_two_send_it(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "NAMED_VALUE_FLOAT", name="battpos", value=k)
        log.write_message(k, "NAMED_VALUE_FLOAT", name="battpos", value=-9.0, component=99)
        log.write_message(k, "NAMED_VALUE_FLOAT", name="ballast", value=200.0 + k, component=99)
        log.write_message(k, "RAW_IMU", xmag=100 + k)
    back = logs.read(log.write(tmp_path))
    np.testing.assert_array_equal(back["battpos"], range(5))
    np.testing.assert_array_equal(back["ballast"], 200.0 + np.arange(5))


def test_a_gimbals_attitude_is_not_the_vehicles(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "ATTITUDE", pitch=0.1)
        for _ in range(3):
            log.write_message(k, "ATTITUDE", component=154, pitch=-1.2)
        log.write_message(k, "RAW_IMU", xmag=k)
    back = logs.read(log.write(tmp_path))
    np.testing.assert_allclose(back["pitch"], np.degrees(0.1), rtol=1e-6)


def test_a_temperature_of_0_is_none(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "RAW_IMU", xmag=k, temperature=0)
    assert "imu_temperature" not in logs.read(log.write(tmp_path))


def test_another_compass_makes_the_rows(tmp_path: Path) -> None:
    log = Log()
    for k in range(5):
        log.write_message(k, "RAW_IMU", xmag=k)
        log.write_message(k + 0.5, "SCALED_IMU2", xmag=50 + k)
    path = log.write(tmp_path)
    assert [one.number for one in compasses_in(logs.read(path))] == [0, 1]
    back = logs.read(path, options=Options(compass="1"))
    np.testing.assert_allclose(back["mag_x"], 100.0 * (50 + np.arange(5)))
    np.testing.assert_allclose(back["time"] - T0 / S, 0.5 + np.arange(5))
