"""Test ArduPilot's records: every field equals pymavlink's, and damage costs only the damaged records."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_files import KINDS, Log, described
from pymavlink.DFReader import DFReader_binary, DFReader_text

from magbridge import logs
from magbridge.logs import Options
from magbridge.logs.compasses import compasses_in
from magbridge.logs.dataflash import Flash, read_binary, read_text
from magbridge.logs.deployment import noted

EVERYTHING = {name: set(fields.split(",")) for name, (_, _, fields) in KINDS.items()}


def flight(rows: int = 40, seed: int = 0) -> Log:
    """Return a log with records of every kind, whose fields hold the bytes of headers now and then."""
    rng, log = np.random.default_rng(seed), Log()
    for k in range(rows):
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
        for field, values in records.fields.items():
            expected = np.array([one[field] for one in theirs[name]], dtype=float)
            np.testing.assert_array_equal(values, expected, err_msg=f"{name}.{field}")
        for field, texts in records.texts.items():
            assert texts == [str(one[field]).rstrip("\0") for one in theirs[name]], (name, field)
    return sum(len(theirs[name]) for name in ours.records)


def test_every_field_is_as_pymavlink_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(flight().data)
    ours = read_binary(path, EVERYTHING)
    assert ours.skipped == 0
    assert same_as_pymavlink(path, DFReader_binary, ours) == 40 * 8


def test_every_field_of_a_text_log_is_as_pymavlink_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    path.write_text("\n".join(flight().lines) + "\n")
    ours = read_text(path, EVERYTHING)
    assert ours.skipped == 0
    assert same_as_pymavlink(path, DFReader_text, ours) == 40 * 8


@pytest.mark.parametrize("records", [1, 2])
def test_a_log_in_which_no_record_joins_another_holds_none(records: int, tmp_path: Path) -> None:
    fmt = described(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    (tmp_path / "log.bin").write_bytes((fmt + b"?") * records)
    ours = read_binary(tmp_path / "log.bin", EVERYTHING)
    assert (ours.records, ours.skipped) == ({}, 90 * records)


def test_of_a_record_with_a_field_of_unknown_length_what_stands_before_it_is_read(tmp_path: Path) -> None:
    """The reader reads nothing beyond the record's end, even with a damaged description."""
    log = Log({"MAG": (14, "Qhh", "TimeUS,MagX,MagY")})
    odd = described(14, 15, "MAG", "Qh?nZ", "TimeUS,MagX,Odd,MagY,MagZ")
    rows = b"".join(log.record("MAG", 1000 * k, k, -k) for k in range(5))
    path = tmp_path / "log.bin"
    path.write_bytes(described(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns") + odd + rows)
    ours = read_binary(path, {"MAG": {"TimeUS", "MagX", "MagY", "MagZ"}}).records["MAG"]
    assert ours.fields.keys() == {"TimeUS", "MagX"}
    assert ours.fields["MagX"].tolist() == [0, 1, 2, 3, 4]
    assert not ours.texts


@pytest.mark.real
def test_a_real_log_is_as_pymavlink_reads_it(real_data: Path) -> None:
    path = real_data / "ardusub" / "small.BIN"
    wanted: dict[str, set[str]] = {}
    with DFReader_binary(str(path)) as log:
        while record := log.recv_msg():
            wanted.setdefault(record.get_type(), set(record.fmt.columns))
    ours = read_binary(path, wanted)
    assert ours.skipped == 0
    ours.records.pop("DSF", None)
    assert same_as_pymavlink(path, DFReader_binary, ours) > 5000


def test_text_and_bytes_are_the_same_log(tmp_path: Path) -> None:
    log, binary, text = flight(), tmp_path / "a.bin", tmp_path / "a.log"
    binary.write_bytes(log.data)
    text.write_text("\n".join(log.lines))
    first, second = read_binary(binary, EVERYTHING), read_text(text, EVERYTHING)
    assert first.records.keys() == second.records.keys()
    for name, records in first.records.items():
        assert records.texts == second.records[name].texts
        for field, values in records.fields.items():
            np.testing.assert_allclose(values, second.records[name].fields[field], rtol=1e-6, atol=1e-6)


@given(at=st.integers(0, 319), junk=st.binary(min_size=1, max_size=300))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_junk_between_records_costs_no_record(at: int, junk: bytes, tmp_path: Path) -> None:
    """The reader counts the junk bytes, unless they are themselves records."""
    log, path = flight(), tmp_path / "log.bin"
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
    log, path = Log(), tmp_path / "log.bin"
    for k in range(20):
        log.mag(k * 100_000, 0, (k, 20, -300))
        if k == 10:
            log.data = log.data[:-20]
    path.write_bytes(log.data)
    mag = read_binary(path, EVERYTHING).records["MAG"]
    np.testing.assert_array_equal(mag.fields["MagX"], np.delete(np.arange(20), 10))
    np.testing.assert_array_equal(mag.fields["MagZ"], -300)


def test_a_kind_that_is_described_again(tmp_path: Path) -> None:
    """After a boot with other firmware, each record is read by the description that precedes it."""
    first, second = Log(), Log({**KINDS, "BARO": (16, "QBffH", "TimeUS,I,Alt,Press,More")})
    for log, alt in ((first, 1.0), (second, 2.0)):
        for k in range(5):
            log.write_message("BARO", k, 0, alt, 1e5, *([7] if log is second else []))
    path = tmp_path / "log.bin"
    path.write_bytes(first.data + second.data)
    ours = read_binary(path, EVERYTHING)
    assert ours.skipped == 0
    np.testing.assert_array_equal(ours.records["BARO"].fields["Alt"], [1.0] * 5 + [2.0] * 5)


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
    path = tmp_path / "log.bin"
    path.write_bytes(damaged + b"\xa3\x95\x07damage" * 5000 + flight().data)
    ours = read_binary(path, EVERYTHING)
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
        path = tmp_path / f"{has_compass}.bin"
        path.write_bytes(log.data)
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
    path = tmp_path / "log.bin"
    path.write_bytes(log.data)
    back = logs.read(path)
    assert set(back["battery_current"].to_numpy()) == {27.0}
    assert set(back["battery_voltage"].to_numpy()) == {16.0}
    assert any("hundredths" in note for note in noted(back.attrs)) == (factor == 100)
