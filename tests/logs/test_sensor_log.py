"""Test that a sensor's log gets a vehicle's telemetry at the sensor's times, with gaps counted."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from commands import Command
from log_files import segment
from scipy.spatial.transform import Rotation

from magbridge import logs
from magbridge.errors import FormatError, WrongUse
from magbridge.logs import Options
from magbridge.logs.access import read_apart
from magbridge.logs.deployment import deployment, noted, passed_over

START = 1_700_000_000.0


def vehicle(path: Path, *, shift_s: float = 0.0, **more: Any) -> Path:
    """Write 200 s of a vehicle's telemetry, a row every 4 s, with a gap of 60 s."""
    time = START + np.r_[0:80:4.0, 140:201:4.0]
    columns = {
        "heading": (350.0 + (time - START)) % 360.0,
        "latitude": 47.0 + 1e-5 * (time - START),
        "longitude": (179.999 + 1e-4 * (time - START) + 180.0) % 360.0 - 180.0,
        "battpos": 0.01 * (time - START),
        "pump_on": np.where(time < START + 50, 0.0, 1.0),
        **more,
    }
    logs.write(deployment(path, time + shift_s, columns, {"battpos": "in"}), path)
    return path


def fluxgate(path: Path, time: np.ndarray) -> Path:
    """Write a fluxgate's log without attitude and position."""
    axes = {"mag_x": 20_000.0 + time % 7, "mag_y": 1_000.0 + time % 5, "mag_z": 45_000.0 + time % 3}
    logs.write(deployment(path, time, axes), path)
    return path


@pytest.fixture
def both(tmp_path: Path) -> tuple[Path, Path]:
    """Return a fluxgate's log at 1 Hz, 10 s longer at both ends than the vehicle's log, and that log."""
    time = START + np.arange(-10.0, 211.0) + 0.5
    return fluxgate(tmp_path / "fluxgate.csv", time), vehicle(tmp_path / "vehicle.nc")


def test_rows_are_the_sensors_and_columns_follow_the_rule_of_their_kind(both: tuple[Path, Path]) -> None:
    log = logs.read(both)
    seconds = log["time"].to_numpy() - START
    assert log.sizes["time"] == 221
    inside = (seconds > 0) & (seconds < 76)
    np.testing.assert_allclose(log["battpos"][inside], 0.01 * seconds[inside], atol=1e-6)
    turn = (log["heading"].to_numpy()[inside] - 350.0 - seconds[inside] + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(turn, 0.0, atol=1e-4)
    across = (log["longitude"].to_numpy()[inside] - 179.999 - 1e-4 * seconds[inside] + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(across, 0.0, atol=1e-6)
    assert set(log["pump_on"].to_numpy()[inside]) == {0.0, 1.0}  # a switch has no value in between
    in_gap = (seconds > 76) & (seconds < 140)
    assert np.isnan(log["battpos"].to_numpy()[in_gap]).all()
    assert passed_over(log.attrs) == {"rows_in_gaps": int(in_gap.sum()), "rows_outside": 21}
    (note,) = noted(log.attrs)
    assert "199 s in common" in note
    assert "clocks are assumed to agree" in note


def test_order_of_files_and_streaming_make_no_difference(both: tuple[Path, Path]) -> None:
    whole = logs.read(both)
    for files in (both, both[::-1]):
        pieces = list(logs.read_chunks(files, 50))
        streamed = xr.concat(pieces, "time")
        xr.testing.assert_allclose(streamed.drop_attrs(), whole.drop_attrs())
        assert passed_over(*(piece.attrs for piece in pieces)) == passed_over(whole.attrs)
        assert sum(len(noted(piece.attrs)) for piece in pieces) == 1


def test_a_clock_offset_is_added_to_the_sensors_times(both: tuple[Path, Path], tmp_path: Path) -> None:
    late = vehicle(tmp_path / "late.nc", shift_s=1_000.0)
    with pytest.raises(FormatError, match="clock-offset"):
        logs.read([both[0], late])
    with pytest.raises(FormatError, match="clock-offset"):
        list(logs.read_chunks([both[0], late]))
    log = logs.read([both[0], late], options=Options(clock_offset_s=1_000.0))
    expected = logs.read(both)
    np.testing.assert_allclose(log["time"], expected["time"] + 1_000.0)
    np.testing.assert_allclose(log["battpos"], expected["battpos"], atol=1e-9)
    with pytest.raises(WrongUse, match="sensor's log"):
        logs.read(both[1], options=Options(clock_offset_s=1.0))


def test_a_sensor_that_counts_from_its_boot_needs_the_offset(both: tuple[Path, Path], tmp_path: Path) -> None:
    rows = "\n".join(f"{k}.5,20000,1000,45000" for k in range(100))
    boot = tmp_path / "boot.csv"
    boot.write_text(f"seconds,mag_x,mag_y,mag_z\n{rows}\n")
    with pytest.raises(FormatError, match="count from a start"):
        logs.read([boot, both[1]])
    log = logs.read([boot, both[1]], options=Options(clock_offset_s=START))
    other = tmp_path / "other.csv"  # of another boot, so that one offset cannot be right for both
    other.write_text(boot.read_text().replace(",1000,", ",-1000,"))
    for read in (logs.read, logs.read_chunks):
        with pytest.raises(FormatError, match=r"other\.csv: counts from another boot .* own --clock-offset"):
            list(read([boot, other, both[1]], options=Options(clock_offset_s=START)))
    assert log["time"][0] == START + 0.5
    assert log.attrs.get("time_reference", "utc") == "utc"


def test_a_vehicle_with_a_compass_keeps_it_under_a_number(both: tuple[Path, Path], tmp_path: Path) -> None:
    own: dict[str, Any] = {f"mag_{axis}": np.full(36, 1.0 + k) for k, axis in enumerate("xyz")}
    equipped = vehicle(tmp_path / "equipped.nc", **own)
    log = logs.read(equipped, options=Options(sensor_log=(both[0],)))
    assert log.sizes["time"] == 221
    assert float(log["mag_x"].median()) > 19_000.0
    assert float(log["mag2_z"].median()) == 3.0


def test_a_declared_column_is_that_of_the_log_which_has_it(
    both: tuple[Path, Path], tmp_path: Path, command: Command
) -> None:
    logger = tmp_path / "logger.csv"
    head, rows = both[0].read_text().split("\n", 1)
    logger.write_text(re.sub(r"mag_([xyz])[^,]*", r"F\1 [nT]", head) + "\n" + rows)
    declared = ["mag_x=Fx", "mag_y=Fy", "mag_z=Fz", "piston=battpos"]
    given = [word for one in declared for word in ("--column", one)]
    for files in ([logger, both[1]], [both[1], logger]):
        log = logs.read(files, options=Options(column=tuple(declared)))
        assert (log.sizes["time"], "piston" in log, "battpos" in log) == (221, True, False)
        np.testing.assert_array_equal(log["mag_y"], logs.read(both)["mag_y"])
        assert "files_skipped" not in passed_over(log.attrs)
        assert "together: 221 rows" in command("info", *files, *given).out
        with pytest.raises(FormatError, match="column 'nowhere': expected this column"):
            logs.read(files, options=Options(column=(*declared, "ballast=nowhere")))


def test_a_slocums_science_file_is_not_read_apart(both: tuple[Path, Path], tmp_path: Path) -> None:
    time = START + np.arange(0.0, 200.0, 4.0)
    for name in ("flight.dbd", "flight.ebd"):
        clock = "m_present_time" if name == "flight.dbd" else "sci_m_present_time"
        segment(tmp_path / name, {clock: time, "m_lat": np.full(len(time), 4700.0)})
    files = [both[0], tmp_path / "flight.dbd", tmp_path / "flight.ebd"]
    assert [path.name for path in read_apart(files)[0]] == ["fluxgate.csv", "flight.dbd"]


@pytest.mark.real
def test_a_fluxgate_and_a_slocum(real_data: Path, tmp_path: Path, command: Command) -> None:
    """Commands take the real telemetry of a deployment and a made fluxgate's log."""
    flight = sorted((real_data / "slocum_comet").glob("*.dbd"))[:3]
    glider = logs.read(flight)
    time = np.arange(float(glider["time"][0]) + 60.0, float(glider["time"][0]) + 5_400.0, 6.0)
    attitude = [np.unwrap(glider[name], period=360.0) for name in ("heading", "pitch", "roll")]
    angles = np.stack([np.interp(time, glider["time"], values) for values in attitude], axis=1)
    field = Rotation.from_euler("ZYX", angles, degrees=True).inv().apply([17_000.0, 0.0, 47_000.0])
    moved = np.interp(time, glider["time"], glider["battpos"])
    field[:, 0] += 300.0 + 80.0 * moved
    axes = dict(zip(("mag_x", "mag_y", "mag_z"), field.T, strict=True))
    axes["reference_field"] = np.full(len(time), np.hypot(17_000.0, 47_000.0))
    sensor = tmp_path / "fluxgate.csv"
    logs.write(deployment(sensor, time, axes), sensor)
    log = logs.read([sensor, *flight])
    assert log.sizes["time"] == len(time)
    for name in ("roll", "pitch", "heading", "latitude", "depth", "battpos"):
        # segments of the flight log have gaps in between
        assert float(log[name].notnull().mean()) > 0.95, name
    calibration, corrected = tmp_path / "cal.json", tmp_path / "corrected.csv"
    files = [sensor, *flight]
    done = command("calibrate", *files, "--parameter", "battpos", "-o", calibration)
    assert "in common" in done.err
    command("correct", *files, "--calibration", calibration, "-o", corrected)
    assert logs.read(corrected).sizes["time"] == len(time)
    # a science file is read with its flight file, not once more
    done = command("info", *files, *(path.with_suffix(".ebd") for path in flight))
    assert f"{len(files)} logs together" in done.out
    assert "duplicate" not in done.err
