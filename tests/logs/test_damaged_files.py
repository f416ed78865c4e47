"""Damage that once hung or crashed a reader: a result, or one line that names the file."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from magbridge import guard
from magbridge.errors import FormatError
from magbridge.logs import read

pq = pytest.importorskip("pyarrow.parquet")
pa = pytest.importorskip("pyarrow")


def test_a_parquet_file_without_rows(tmp_path: Path) -> None:
    names = ["time", "mag_x", "mag_y", "mag_z"]
    schema = pa.schema([(name, pa.float64()) for name in names])
    pq.ParquetWriter(tmp_path / "a.parquet", schema).close()
    with pytest.raises(FormatError, match="expected rows, there are none"):
        read(tmp_path / "a.parquet")


def test_a_slocums_header_that_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a.dbd"
    path.write_bytes(b"dbd_label:    DBD(dinkum_binary_data)file\n")
    with pytest.raises(FormatError, match="the header is cut off"):
        read(path)
    path.write_bytes(
        b"dbd_label:    DBD(dinkum_binary_data)file\nencoding_ver:    5\nnum_ascii_tags:    14\n"
    )
    with pytest.raises(FormatError, match="the header is cut off"):
        read(path)


def test_a_damaged_list_of_sensors_is_named(real_data: Path, tmp_path: Path) -> None:
    for name in ("comet-2016-174-05-003.dbd", "11d38bfd.cac"):
        shutil.copy(real_data / "slocum_comet" / name, tmp_path)
    cache = tmp_path / "11d38bfd.cac"
    lines = cache.read_bytes().splitlines(keepends=True)
    lines[1618] = b"s: T 1618 1618 99999999999999999999999 u\n"
    cache.chmod(0o644)
    cache.write_bytes(b"".join(lines))
    with pytest.raises(FormatError, match=r"11d38bfd\.cac: row 1619: expected a sensor"):
        read(tmp_path / "comet-2016-174-05-003.dbd")


@pytest.mark.parametrize("key", [b"sensors_per_cycle", b"state_bytes_per_cycle"])
def test_a_slocums_number_that_is_too_large_for_its_reader(
    key: bytes, real_data: Path, tmp_path: Path
) -> None:
    for name in ("comet-2016-174-05-003.dbd", "11d38bfd.cac"):
        shutil.copy(real_data / "slocum_comet" / name, tmp_path)
    path = tmp_path / "comet-2016-174-05-003.dbd"
    whole = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(whole.replace(key + b":    ", key + b":    " + b"9" * 23, 1))
    with pytest.raises(FormatError, match="expected a whole Slocum file"):
        read(path)


@pytest.mark.parametrize("name", ["no_row_group.parquet", "attribute.nc", "hangs.ulg", "short.dbd"])
def test_files_that_once_failed(cases: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A result, or one line: within the guard's processor time."""
    monkeypatch.setattr(guard, "SECONDS", 2.0)
    path = cases / "files" / name
    output = f"{path}: "
    try:
        assert read(path).sizes["time"] > 0
    except FormatError as error:
        output = str(error)
    assert output.startswith(f"{path}: ")
    assert "\n" not in output
    assert "cannot be read, damaged?" not in output, "nobody foresaw it"


def test_a_quotation_mark_that_is_never_closed_costs_its_row(tmp_path: Path) -> None:
    """It once took all that follows for one cell: pandas' ParserError."""
    path = tmp_path / "log.csv"
    rows = [f"{1_700_000_000 + 4 * k},20000.0,{k}.0,40000.0\n" for k in range(20)]
    rows[7] = '1700000028,20000.0,"7.0,40000.0\n'
    path.write_text("time,mag_x,mag_y,mag_z\n" + "".join(rows))
    got = read(path)
    assert got["mag_y"].to_numpy().tolist() == [*range(7), *range(8, 20)]
    rows[7] = '1700000028,20000.0,"7.0",40000.0\n'
    path.write_text("time,mag_x,mag_y,mag_z\n" + "".join(rows))
    assert read(path)["mag_y"].to_numpy().tolist() == list(range(20))
