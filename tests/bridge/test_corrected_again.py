"""Test that `magbridge correct` on a bridge's own log reproduces the published field, sigmas and flags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from fed import logged
from small import START, small_bridge

from magbridge import logs
from magbridge.bridge.events import Event, StartEvent, standstill
from magbridge.calibration.file import load as load_calibration
from magbridge.columns import CORRECTED
from magbridge.correction import Correction
from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAV_PARAM_TYPE
from magbridge.records import Channel, Quality
from magbridge.rows import correct_rows

KEPT = {"MB_AGE_BATTPOS": 3.0, "MB_SETTLE_TIME": 4.0, "MB_STALE_GROW": 20.0}
"""Parameters that an earlier run set over the link."""


def second(k: int, *frames: bytes) -> Iterator[Event]:
    """Yield the events of second `k`: frames of the link 0.4 s before a reading."""
    for frame in frames:
        yield Event(START + k * 1_000_000 - 400_000, Channel.LINK, frame)
    yield Event(START + k * 1_000_000, Channel.SENSOR, b"12340.5 43210.9 -234.5 4.0 %d 7\r\n" % k)


def battery(position: float) -> bytes:
    return Codec(1, 1).pack("NAMED_VALUE_FLOAT", name="battpos", value=position)


@pytest.mark.parametrize("suffix", ["nc", "csv", "tlog"])
def test_what_was_set_in_the_course_of_the_log_is_reported(
    tmp_path: Path, suffix: str, command: Command
) -> None:
    """The correction repeats neither rejected values nor the rate of a message."""
    station, log = Codec(1, 1), tmp_path / f"converted.{suffix}"
    asked = {10: ("MB_SETTLE_TIME", 4.0), 20: ("MB_SETTLE_TIME", -1.0), 30: ("MB_R_HIGHRES_IMU", 1.0)}
    to = {"target_system": 1, "target_component": 191, "param_type": MAV_PARAM_TYPE.REAL32}

    def events() -> Iterator[Event]:
        for k in range(40):
            sets = [asked[k]] if k in asked else []
            yield from second(
                k, *(station.pack("PARAM_SET", param_id=n, param_value=v, **to) for n, v in sets)
            )

    logged(small_bridge(tmp_path), events(), tmp_path / "logs")
    logs.write(logs.read(sorted((tmp_path / "logs").iterdir())), log)
    reported = command("correct", log, "--calibration", "cal.json", "-o", "out.nc").err
    assert "MB_* parameters were set once in the course of the log" in reported


@pytest.mark.parametrize(("suffix", "precision"), [("nc", 1e-7), ("csv", 1e-7), ("tlog", 1e-6)])
def test_flags_and_sigmas_are_those_of_the_bridge(tmp_path: Path, suffix: str, precision: float) -> None:
    """Telemetry arrives every few seconds, is missing for a minute once, and is unknown once."""
    rng = np.random.default_rng(1)

    def events() -> Iterator[Event]:
        for k in range(400):
            position = np.nan if 300 <= k < 310 else 0.1 * (k // 50)
            is_sent = rng.random() < 0.4 and not 200 <= k < 260
            yield from second(k, *([battery(position)] if is_sent else []))

    logged(small_bridge(tmp_path, start=StartEvent(START, KEPT)), events(), tmp_path / "logs")
    rows = logs.read(sorted((tmp_path / "logs").iterdir()))
    logs.write(rows, tmp_path / f"converted.{suffix}")
    converted = logs.read(tmp_path / f"converted.{suffix}")
    again = correct_rows(Correction(load_calibration(tmp_path / "cal.json")), converted)
    seen = {flag for flag in Quality for quality in rows["quality"].to_numpy() if int(quality) & flag}
    assert {Quality.STALE_TELEMETRY, Quality.MOVING} <= seen
    for name in set(CORRECTED) - {"anomaly", "quality"}:
        np.testing.assert_allclose(again[name], rows[name], rtol=precision, err_msg=name)
    before, after = (one["quality"].to_numpy().astype(int) for one in (rows, again))
    more = before != after
    assert (after[more] == before[more] + Quality.MOVING).all()
    assert (before[np.flatnonzero(more) + 1] & Quality.MOVING != 0).all()
    assert 3 <= more.sum() <= 7, (
        "the last sample before each of seven motions, but where both are of one time"
    )


def test_what_a_bridge_has_flagged_as_late_stays_so(tmp_path: Path) -> None:
    """The rows of a log do not show that the bridge paused for 5 s while the mass moved."""

    def events() -> Iterator[Event]:
        for k in range(20):
            if k == 10:
                stall = standstill(START + k * 1_000_000, 5_000_000)
                yield Event(START + k * 1_000_000 - 400_000, Channel.STATE, stall)
            yield from second(k, battery(0.9 if k >= 10 else 0.0))

    logged(small_bridge(tmp_path), events(), tmp_path / "logs")
    rows = logs.read(sorted((tmp_path / "logs").iterdir()))
    again = correct_rows(Correction(load_calibration(tmp_path / "cal.json")), rows)
    late = rows["quality"].to_numpy().astype(int) & Quality.LATE_JOIN != 0
    assert late.any()
    assert ((again["quality"].to_numpy().astype(int) & Quality.LATE_JOIN != 0) == late).all()
    assert (again["total_field_sigma"].to_numpy()[late] >= rows["total_field_sigma"].to_numpy()[late]).all()
