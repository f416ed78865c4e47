"""Test ArduPilot's logs: records as pymavlink reads them, and logs that were once silently read wrong."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_files import KINDS, Log, described
from pymavlink.DFReader import DFReader_binary, DFReader_text

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.compasses import compasses_in
from magbridge.logs.dataflash import Flash, read_binary, read_text
from magbridge.logs.deployment import noted, passed_over
from magbridge.logs.mapping import Options

UTC = 1_700_000_000


def flight(*, gps: bool = True, compasses: int = 1, log: Log | None = None) -> Log:
    """Return a log with 30 rows, one each 0.1 s from 5 s after the boot on."""
    log = log or Log()
    for k in range(30):
        us = 5_000_000 + k * 100_000
        if gps and k % 5 == 0:
            log.fix(us, UTC + us * 1e-6)
        log.write_message("ATT", us, 0, 1.0, 0, -5.0, 0, float(k), 0, 0, 3)
        log.write_message("BAT", us, 0, 16.0, 0.1 * k)
        for number in range(compasses):
            log.mag(us, number, (100 + k, 200 * (1 + number), -300), 1, [7, 0, 0, 0, 0, 50])
    return log


def write(tmp_path: Path, log: Log, name: str = "log.bin") -> Path:
    path = tmp_path / name
    path.write_bytes(log.data)
    return path


@pytest.mark.parametrize("compensation", ["MO", "MOfs"])
def test_the_motors_share_is_taken_off_by_either_name(compensation: str, tmp_path: Path) -> None:
    """Up to ArduPilot 4.0 it is MOfsX."""
    fields = ",".join(
        ["TimeUS", *(f"{what}{axis}" for what in ("Mag", "Ofs", compensation) for axis in "XYZ")]
    )
    log = Log({"MAG": (14, "Qhhhhhhhhh", fields)})
    for k in range(5):
        log.write_message("MAG", k * 100_000, 100 + 3 * k, 200, -300, 10, 20, 30, 3 * k, 0, -5)
    back = logs.read(write(tmp_path, log))
    np.testing.assert_array_equal(back["mag_x"], 9_000.0)
    np.testing.assert_array_equal(back["mag_z"], -32_500.0)


def test_a_log_of_the_times_when_times_were_in_milliseconds(tmp_path: Path) -> None:
    """Up to ArduPilot 3.2: TimeMS since the boot, but of a GPS since the week began, its T since the boot."""
    path = tmp_path / "old.log"
    columns = "MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOfsX,MOfsY,MOfsZ"
    week, ms = divmod(UTC - 315_964_800 + 18, 604_800)
    described = [
        f"FMT, 15, 25, MAG, Ihhhhhhhhh, TimeMS,{columns}",
        "FMT, 1, 19, ATT, IccccCC, TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw",
        "FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
    ]
    records = [
        line
        for k in range(20)
        for line in (
            f"GPS, 3, {1000 * ms + 200 * k}, {week}, 9, 1, 47.5, 8.5, 1, 400, 0, 0, 0, {5000 + 200 * k}",
            f"ATT, {5000 + 200 * k}, 0, 1.5, 0, -2, 0, {k}",
            f"MAG, {5010 + 200 * k}, {100 + k}, 200, -300, 10, 0, 0, 0, 5, 0",
        )
    ]
    path.write_text("\n".join([*described, *records]))
    back = logs.read(path)
    assert not passed_over(back.attrs)
    np.testing.assert_allclose(back["time"], UTC + 0.01 + 0.2 * np.arange(20), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(back["mag_x"], 9_000.0 + 100 * np.arange(20))
    np.testing.assert_array_equal(back["mag_y"], 19_500.0)
    np.testing.assert_array_equal(back["heading"], np.arange(20))
    assert (back["latitude"] == 47.5).all()


def test_angles_currents_and_places_are_in_the_rows(tmp_path: Path) -> None:
    log = Log()
    log.write_message("BAT", 5_000_000, 1, 12.0, 0.5)
    back = logs.read(write(tmp_path, flight(compasses=2, log=log)))
    k = np.arange(30.0)
    np.testing.assert_allclose(back["time"], UTC + 5 + 0.1 * k, rtol=0, atol=1e-3)
    expected: dict[str, Any] = {"mag_x": 100.0 * (93 + k), "mag_z": -35_000.0, "mag2_y": 40_000.0}
    expected |= {"roll": 1.0, "pitch": -5.0, "heading": k, "latitude": 45.0}
    expected |= {"battery_current": 0.1 * k, "battery2_current": 0.5}
    for name, values in expected.items():
        np.testing.assert_allclose(back[name], np.broadcast_to(values, 30), rtol=1e-6, err_msg=name)
    assert (back.attrs["bytes_skipped"], "time_reference" in back.attrs) == (0, False)


def test_the_soft_iron_matrix_is_undone(tmp_path: Path) -> None:
    """MAG = D (raw + Ofs) + MO, with D of COMPASS_DIA and COMPASS_ODI."""
    log = Log()
    matrix = np.array([[1.1, 0.05, -0.02], [0.05, 0.9, 0.03], [-0.02, 0.03, 1.05]])
    elements = {"DIA": (1.1, 0.9, 1.05), "ODI": (0.05, -0.02, 0.03)}
    for kind, values in elements.items():
        for axis, value in zip("XYZ", values, strict=True):
            log.write_message("PARM", 0, f"COMPASS_{kind}_{axis}", value)
    raw = np.random.default_rng(0).uniform(-400, 400, (50, 3))
    for k, one in enumerate(raw):
        field = matrix @ (one + np.array([20, -30, 40])) + np.array([5, 0, -5])
        log.mag(k * 100_000, 0, field.round().astype(int).tolist(), 1, [20, -30, 40, 5, 0, -5])
    back = logs.read(write(tmp_path, log))
    found = np.stack([back[f"mag_{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(found, 100 * raw, rtol=0, atol=100)  # mG are whole


def test_the_compass_that_flew_is_read(tmp_path: Path) -> None:
    """The first is disabled and unhealthy; the third is another."""
    log = Log()
    for name, value in (("USE", 0.0), ("USE2", 1.0), ("USE3", 1.0), ("DEV_ID2", 97539.0)):
        log.write_message("PARM", 0, f"COMPASS_{name}", value)
    for k in range(20):
        for number in range(3):
            log.mag(k * 100_000, number, (number, 0, 0), health=number)
    path = write(tmp_path, log)
    back = logs.read(path)
    assert (back["mag_x"] == 100).all()
    assert {"mag1_x", "mag3_x"} <= set(back.data_vars)
    found = compasses_in(back)
    assert [one.chosen for one in found] == [False, True, False]
    assert [one.enabled for one in found] == [False, True, True]
    assert [one.healthy for one in found] == [0, 1, 1]
    assert [one.id for one in found] == ["", "97539", ""]
    assert "compass 1" in noted(back.attrs)[0]
    assert (logs.read(path, options=Options(compass="2"))["mag_x"] == 200).all()
    assert (logs.read(path, options=Options(compass="97539"))["mag_x"] == 100).all()
    with pytest.raises(FormatError, match=r"expected a compass '7'; there are: compass 0: .*disabled"):
        logs.read(path, options=Options(compass="7"))


def test_the_estimators_word_goes_before_the_number(tmp_path: Path) -> None:
    log = Log()
    for k in range(9):
        log.write_message("XKFS", 4_900_000 + k, 0, int(k > 2), 0, 0, 0)
    back = logs.read(write(tmp_path, flight(compasses=2, log=log)))
    assert (back["mag_y"] == 40_000).all()


def test_a_boot_without_gps_is_left_out_and_counted(tmp_path: Path) -> None:
    back = logs.read(write(tmp_path, flight(log=flight(), gps=False)))
    assert back.sizes["time"] == 30
    assert passed_over(back.attrs) == {"rows_dropped": 30}
    assert "no date" in " ".join(noted(back.attrs))


def test_boots_without_any_date_follow_each_other(tmp_path: Path) -> None:
    back = logs.read(write(tmp_path, flight(log=flight(gps=False), gps=False)))
    assert back.sizes["time"] == 60
    assert back.attrs["time_reference"] == "boot"
    assert float(np.diff(back["time"]).max()) == pytest.approx(60)


def test_units_that_the_log_declares(tmp_path: Path) -> None:
    """The pressure is in hPa: declared as Pa, with a multiplier of 100."""
    log = Log()
    for letter, label in (("P", "Pa"), ("m", "m"), ("s", "s")):
        log.write_message("UNIT", 0, ord(letter), label)
    for letter, factor in (("-", 0.0), ("2", 100.0), ("0", 1.0)):
        log.write_message("MULT", 0, ord(letter), factor)
    log.write_message("FMTU", 0, 16, "s-mP", "--02")
    log.write_message("BARO", 4_900_000, 0, -3.0, 1013.0)
    back = logs.read(write(tmp_path, flight(log=log)))
    np.testing.assert_allclose(back["pressure"], 1013.0)
    np.testing.assert_allclose(back["depth"], 3.0)


@pytest.mark.parametrize("name", ["log.bin", "log.log", "log.tlog"])
def test_a_log_is_what_its_bytes_say(name: str, tmp_path: Path) -> None:
    log = flight()
    path = tmp_path / name
    path.write_bytes(log.data)
    binary = logs.read(path)
    path.write_text("\n".join(log.lines) + "\nno record\n")
    text = logs.read(path)
    assert passed_over(text.attrs) == {"lines_skipped": 1}
    for column in binary.data_vars:
        np.testing.assert_allclose(text[column], binary[column], rtol=1e-6, err_msg=str(column))


CASES = {
    # file of the collection: rows, first time, counts
    "first_compass_unhealthy.BIN": (300, 1646824782.0, {}),
    "first_gps_time.BIN": (600, 1646824782.0, {}),
    "motor_compensation_old_names.BIN": (600, 1646824782.0, {}),
    "no_gps_position_known.BIN": (600, 5.0, {}),
    "one_mag_time.BIN": (599, 1646824782.0, {"rows_dropped": 1}),
    "two_boots.BIN": (400, 1646824782.0, {}),
    "ardupilot_text.log": (60, 1.0, {}),
    "first_compass_disabled.ulg": (300, 1650000002.0, {}),
    "magnetic_field_bag": (300, 1700000000.0, {}),
    "clock_ahead_once.tlog": (199, 1700000000.05, {"rows_dropped": 1}),
    "gimbal_attitude.tlog": (200, 1700000000.05, {}),
    "named_value_heading.tlog": (150, 1700000000.05, {}),
    "raw_imu_temperature_0.tlog": (100, 1700000000.05, {}),
}


@pytest.mark.real
@pytest.mark.parametrize("name", CASES)
def test_a_case(name: str, real_data: Path) -> None:
    """The files of the collection, if they are next to the measured data."""
    path = real_data.parent / "cases" / "logs" / name
    if not path.exists():
        pytest.skip(f"no {name} next to the measured data")
    rows, start, counts = CASES[name]
    back = logs.read(path)
    assert back.sizes["time"] == rows
    assert passed_over(back.attrs) == counts
    assert float(back["time"][0]) == pytest.approx(start, abs=0.2)
    assert ("time_reference" in back.attrs) == (start < 100)
    assert "imu_temperature" not in back
    if "pitch" in back:
        assert float(abs(back["pitch"]).max()) < 40
    length = np.linalg.norm([back[f"mag_{axis}"] for axis in "xyz"], axis=0)
    assert 20_000 < np.median(length) < 70_000


# ---- ArduPilot's records: every field equals pymavlink's, and damage costs only the damaged records --------


EVERYTHING = set(KINDS)


def every_kind() -> Log:
    """Return a log with records of every kind, whose fields hold the bytes of headers now and then."""
    rng, log = np.random.default_rng(0), Log()
    for k in range(40):
        us = k * 100_000 + 7
        log.write_message("PARM", us, f"COMPASS_X{k}", k / 3)
        log.fix(us, 1.7e9 + us * 1e-6)
        log.write_message("ATT", us, *rng.uniform(-180, 180, 4).round(2), *rng.uniform(0, 360, 4).round(2), 3)
        log.write_message("BAT", us, k % 2, 16.5, k / 7)
        log.mag(us, k % 2, rng.integers(-600, 600, 3).tolist(), 1, [0x95A3 - 65536, 14, -27, 1, 2, 3])
        log.write_message("IMU", us, 0, *rng.normal(size=6))
        log.write_message("BARO", us, 0, 1.5, 101_325.0)
        log.write_message("XKFS", us, 0, k % 3, 0, 0, 0)
    return log


def same_as_pymavlink(path: Path, reader: type, ours: Flash) -> int:
    """Compare every number and text that both have read; return how many records there were."""
    theirs: dict[str, list[dict[str, object]]] = {}
    with reader(str(path)) as log:
        while record := log.recv_msg():
            theirs.setdefault(record.get_type(), []).append(record.to_dict())
    for name, records in ours.records.items():
        for field, values in records.items():
            expected = [one[field] for one in theirs[name]]
            expected = [one.rstrip("\0") if isinstance(one, str) else one for one in expected]
            np.testing.assert_array_equal(values, expected, err_msg=f"{name}.{field}")
    return sum(len(theirs[name]) for name in ours.records)


@pytest.mark.parametrize("name", ["log.bin", "log.log"])
def test_every_field_is_as_pymavlink_reads_it(name: str, tmp_path: Path) -> None:
    log, path = every_kind(), tmp_path / name
    is_text = path.suffix == ".log"
    path.write_bytes("\n".join([*log.lines, ""]).encode() if is_text else log.data)
    read, reader = (read_text, DFReader_text) if is_text else (read_binary, DFReader_binary)
    ours = read(path, EVERYTHING)
    assert ours.skipped == 0
    assert same_as_pymavlink(path, reader, ours) == 40 * 8


@pytest.mark.parametrize("records", [1, 2])
def test_a_log_in_which_no_record_joins_another_holds_none(records: int, tmp_path: Path) -> None:
    (tmp_path / "log.bin").write_bytes((Log({}).data + b"?") * records)
    ours = read_binary(tmp_path / "log.bin", EVERYTHING)
    assert (ours.records, ours.skipped) == ({}, 90 * records)


def test_of_a_record_with_a_field_of_unknown_length_what_stands_before_it_is_read(tmp_path: Path) -> None:
    """The reader reads nothing beyond the record's end, even with a damaged description."""
    log = Log({"MAG": (14, "Qhh", "TimeUS,MagX,MagY")})
    odd = described(14, 15, "MAG", "Qh?nZ", "TimeUS,MagX,Odd,MagY,MagZ")
    rows = b"".join(log.record("MAG", 1000 * k, k, -k) for k in range(5))
    log.data = Log({}).data + odd + rows
    ours = read_binary(write(tmp_path, log), {"MAG"}).records["MAG"]
    assert ours.keys() == {"TimeUS", "MagX"}
    assert ours["MagX"].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.real
def test_a_real_log_is_as_pymavlink_reads_it(real_data: Path) -> None:
    path = real_data / "ardusub" / "small.BIN"
    with DFReader_binary(str(path)) as log:
        wanted = {record.get_type() for record in iter(log.recv_msg, None)}
    ours = read_binary(path, wanted)
    assert ours.skipped == 0
    ours.records.pop("DSF", None)
    assert same_as_pymavlink(path, DFReader_binary, ours) > 5000


@given(at=st.integers(0, 319), junk=st.binary(min_size=1, max_size=300))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_junk_between_records_costs_no_record(at: int, junk: bytes, tmp_path: Path) -> None:
    """The reader counts the junk bytes, unless they are themselves records."""
    log, path = every_kind(), tmp_path / "log.bin"
    starts = [place for place in range(len(log.data)) if log.data[place : place + 2] == b"\xa3\x95"]
    heads = [a for a, b in pairwise([*starts, len(log.data)]) if b > a and log.data[a + 2] in range(10, 18)]
    at = heads[at % len(heads)]
    junk = junk.replace(b"\xa3\x95", b"..").rstrip(b"\xa3")
    path.write_bytes(log.data[:at] + junk + log.data[at:])
    clean = tmp_path / "clean.bin"
    clean.write_bytes(log.data)
    before, after = read_binary(clean, EVERYTHING), read_binary(path, EVERYTHING)
    # inside a record (its fields hold header bytes) junk cuts that one
    lost = sum(len(before.records[name].at) - len(after.records[name].at) for name in before.records)
    assert 0 <= lost <= 1
    assert after.skipped >= len(junk)


def test_a_record_that_was_cut_short_is_not_read(tmp_path: Path) -> None:
    """The last fields of a truncated record would be bytes of the next record, not measurements."""
    log = Log()
    for k in range(20):
        log.mag(k * 100_000, 0, (k, 20, -300))
        if k == 10:
            log.data = log.data[:-20]
    mag = read_binary(write(tmp_path, log), EVERYTHING).records["MAG"]
    np.testing.assert_array_equal(mag["MagX"], np.delete(np.arange(20), 10))
    np.testing.assert_array_equal(mag["MagZ"], -300)


@pytest.mark.parametrize("number", [16, 99])
def test_a_kind_that_is_described_again(number: int, tmp_path: Path) -> None:
    """After a boot with other firmware, each record is read by the description that precedes it."""
    first, second = Log(), Log({**KINDS, "BARO": (number, "QBffH", "TimeUS,I,Alt,Press,More")})
    for log, alt in ((first, 1.0), (second, 2.0)):
        for k in range(5):
            log.write_message("BARO", k, 0, alt, 1e5, *([7] if log is second else []))
    first.data += second.data
    ours = read_binary(write(tmp_path, first), EVERYTHING)
    assert ours.skipped == 0
    np.testing.assert_array_equal(ours.records["BARO"]["Alt"], [1.0] * 5 + [2.0] * 5)
    assert "More" not in ours.records["BARO"]


@pytest.mark.parametrize(
    "damaged",
    [
        described(7, 0, "NONE", "", ""),  # a record without a length: a reader may stay there for ever
        described(7, 9, "BAD", "Q", "TimeUS"),  # one whose length is not its fields'
        described(7, 14, "FMTU", "QBN", "TimeUS,FmtType,UnitIds"),
        described(7, 0, "", "xyz", ",,"),
        described(14, 9, "MAG", "Q", "TimeUS"),
    ],
)
def test_a_description_that_contradicts_itself_is_not_believed(damaged: bytes, tmp_path: Path) -> None:
    log = every_kind()
    log.data = damaged + b"\xa3\x95\x07damage" * 5000 + log.data
    ours = read_binary(write(tmp_path, log), EVERYTHING)
    assert len(ours.records["MAG"].at) == 40
    assert ours.skipped >= 5000


def test_survey_magnetometers_are_further_compasses(tmp_path: Path) -> None:
    kinds = {**KINDS, "MAGH": (30, "QBBBfff", "TimeUS,Node,Sensor,Bus,Mx,My,Mz")}
    for has_compass in (True, False):
        log = Log(kinds)
        for k in range(20):
            us = 100_000 * k
            log.fix(us, 1.7e9 + us * 1e-6)
            if has_compass:
                log.mag(us, 0, [200, 100, -400])
            for node in (70, 71):
                log.write_message("MAGH", us + 1000, node, 0, 0, 0.19, 0.001 * node, 0.44)
        path = write(tmp_path, log, f"{has_compass}.bin")
        first = logs.read(path)
        assert [compass.number for compass in compasses_in(first)] == list(range(2 + has_compass))
        chosen = logs.read(path, options=Options(compass="MAGH 71:0:0"))
        np.testing.assert_allclose(chosen["mag_y"], 7_100.0, rtol=1e-6)
        by_number = logs.read(path, options=Options(compass=str(int(has_compass))))
        np.testing.assert_allclose(by_number["mag_y"], 7_000.0, rtol=1e-6)


@pytest.mark.parametrize("factor", [1, 100])
def test_powers_in_hundredths_are_known_by_the_voltage(factor: int, tmp_path: Path) -> None:
    log = Log({**KINDS, "CURR": (31, "Qhh", "TimeUS,Volt,Curr")})
    for k in range(20):
        us = 100_000 * k
        log.fix(us, 1.7e9 + us * 1e-6)
        log.mag(us, 0, [200, 100, -400])
        log.write_message("CURR", us, 16 * factor, 27 * factor)
    back = logs.read(write(tmp_path, log))
    assert set(back["battery_current"].to_numpy()) == {27.0}
    assert set(back["battery_voltage"].to_numpy()) == {16.0}
    assert any("hundredths" in note for note in noted(back.attrs)) == (factor == 100)
