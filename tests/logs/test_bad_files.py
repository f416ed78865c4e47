"""Test that each bad file gives one line with file, row, column and the expected content."""

import errno
import os
import re
import tracemalloc
from pathlib import Path

import netCDF4
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from magbridge import guard, logs
from magbridge.columns import CHANNELS
from magbridge.errors import FormatError
from magbridge.logs import read
from magbridge.logs.deployment import deployment, named_losses, passed_over

SUFFIXES = (".csv", ".nc", ".parquet", ".tlog", ".bin", ".ulg", ".dbd", ".tbd")
BAD_CSV = {
    "": "expected a log, the file is empty",
    "\n1,2\n": "row 1: expected a header row, the file is empty",
    "time,mag_x\n": "row 2: expected rows after the header",
    "s,mag_x\n1,2\n": "row 1, column 'time': expected this column; there are: s mag_x; "
    'if one is it: --column time="THEIRS [unit]"; if none is: --column time="row [20 Hz]", its rate',
    "Timestamp;NavState;": "row 2: expected rows after the header",
    "1,2\n3,4\n": "row 1: expected a header row with the columns' names, not '1,2'; without one, say what "
    'each column is, as --column time="column_1 [s]"',
    "time,water_speed [kn]\n1,2\n": "column 'water_speed': expected m/s, not kn",
    "time,mag_x,mag_x\n1,2,3\n": "row 1: expected a name of its own for column 3, not 'mag_x'",
    "time,mag_x\n1,2\n2\n": "row 3: expected 2 fields, not 1",
    "time,mag_x\n1,2\n2,3,4\n": "row 3: expected 2 fields, not 3",
    "time,mag_x\n1,2\n2,north\n": "row 3, column 'mag_x': expected a number, not 'north'",
    "time,mag_x\n1,2\n,3\n": "row 3, column 'time': expected a time after 1.0, not nan",
    "time,mag_x\n2,2\n1,3\n": "row 3, column 'time': expected a time after 2.0, not 1.0",
    "time,mag_x\n2,2\n2,3\n": "row 3, column 'time': expected a time after 2.0, not 2.0",
    "time,mag_x\n2016-06-23,2\nlater,3\n": "row 3, column 'time': expected a time, not 'later'",
    "time,a\n1.5,2\n2016-06-23,3\n": "row 3, column 'time': expected seconds since 1970, not '2016-06-23'",
    "time,mag_x\n3/4/2022 12:00,2\n3/4/2022 12:01,2\n": (
        "column 'time': day or month first? '3/4/2022 12:00' can be both: "
        '--column time="time [%d/%m/%Y %H:%M]" or --column time="time [%m/%d/%Y %H:%M]"'
    ),
    "time,mag_x [V]\n2,2\n": "column 'mag_x': expected nT, not V",
    "time,water [Celsius]\n1,4\n2,-998\n": (
        "row 3, column 'water': expected at least -273.15 degC, or nothing where it is not known, not -998.0"
    ),
    "# fill_value = none\ntime,mag_x\n1,2\n": "row 1, column 'fill_value': expected a number, not 'none'",
    "time,quality\n2,splendid\n": "row 2, column 'quality': expected the names of flags, not 'splendid'",
    "# heading_reference = Magnetic\ntime,heading\n1,2\n": (
        "heading_reference: expected true, magnetic or inertial, not 'Magnetic'"
    ),
    "# heading_reference = magnetic\ntime,a\n1,2\n\n2,x\n": "row 5, column 'a': expected a number, not 'x'",
}


def one_line(error: FormatError, path: Path) -> str:
    text = str(error)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text.removeprefix(f"{path}: ")


def refused(path: Path, rows: int = 0) -> str:
    """Read a file, whole or in pieces of `rows`, that must be refused; return why."""
    with pytest.raises(FormatError) as caught:
        list(logs.read_chunks(path, rows)) if rows else logs.read(path)
    assert caught.value.exit_code == 1
    return one_line(caught.value, path)


@pytest.mark.parametrize("text", BAD_CSV)
@pytest.mark.parametrize("rows", [1, 1000])
def test_csv(text: str, rows: int, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    assert refused(path, rows) == BAD_CSV[text]


def test_csv_of_binary_data_or_too_many_columns(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(b"time,mag_x\n\xff\xfe\x00,1\n")
    assert refused(path) == "expected text in UTF-8"
    path.write_text(",".join(f"c{k}" for k in range(100_000)) + "\n" + ",".join("1" * 100_000) + "\n")
    assert "expected at most 4096 columns, got 100000" in refused(path)


@pytest.mark.parametrize(
    ("header", "words"),
    [("", "expected text, the file is binary"), ("time,mag_x\n1,2\n", "row 3: expected 2 fields, not 1")],
)
def test_csv_of_endless_zeros_is_not_held(header: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(header)
    os.truncate(path, 300_000_000)
    tracemalloc.start()
    assert words in refused(path)
    assert tracemalloc.get_traced_memory()[1] < 30e6
    tracemalloc.stop()
    # a log that ends in the zeros of a crash is read up to there
    path.write_text("time,mag_x\n1,2\n2,3\n3,4\n")
    os.truncate(path, 2_000_000)
    log = logs.read(path)
    assert log["mag_x"].values.tolist() == [2, 3, 4]
    assert passed_over(log.attrs) == {"rows_dropped": 1}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"no log at all\n" * 100, bytes(3000)])
def test_anything_else_under_that_name(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(content)
    assert "expected" in refused(path)


def test_no_file_or_no_format(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    assert refused(path) == refused(path, 1000) == "expected a file, there is none"
    path.mkdir()
    assert refused(path) == "expected a file, not a directory"
    os.mkfifo(tmp_path / "pipe.csv")
    assert refused(tmp_path / "pipe.csv") == "expected a file, not a pipe or a device"
    (tmp_path / "log.xlsx").write_text("x")
    expected = r"expected a file name that ends in one of .*\.csv .*\.ulg"
    assert re.match(expected, refused(tmp_path / "log.xlsx"))
    expected = r"ends in one of \.csv \.magarrow\.csv \.mcap \.nc \.parquet \.tlog \.xyz$"
    with pytest.raises(FormatError, match=expected):
        logs.Writer(tmp_path / "log.ulg")


def test_a_disk_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    path = tmp_path / "log.csv"
    path.write_text("time,mag_x\n1,2\n")
    monkeypatch.setattr(Path, "open", fail)
    assert refused(path) == "cannot be read: Input/output error"


@pytest.mark.parametrize("suffix", [".nc", ".parquet"])
def test_a_file_that_is_truncated_or_whose_time_goes_back(suffix: str, tmp_path: Path) -> None:
    path, cut = tmp_path / f"log{suffix}", tmp_path / f"cut{suffix}"
    noise = np.random.default_rng(0).normal(size=1999)
    logs.write(deployment("made", np.arange(1.0, 2000), {"mag_x": noise}), path)
    data = path.read_bytes()
    for kept in (0.1, 0.5, 0.9, 0.99):
        cut.write_bytes(data[: int(kept * len(data))])
        assert "expected a whole" in refused(cut)
    if suffix == ".nc":
        with netCDF4.Dataset(path, "a") as file:
            file["time"][3] = 2.5
    else:
        table = parquet.read_table(path).to_pandas()
        table.loc[3, "time"] = 2.5
        table.to_parquet(path)
    for rows in (1, 3, 10_000):
        attrs = [piece.attrs for piece in logs.read_chunks(path, rows)]
        assert passed_over(*attrs) == {"rows_dropped": 1}
        assert named_losses(*attrs) == [f"{path}: row 4, column 'time': expected a time after 3.0, not 2.5"]
    with pytest.raises(FormatError, match=r"row 4, column 'time'"):
        logs.read(path, options=logs.Options(strict=True))


def test_netcdf_of_another_shape(tmp_path: Path) -> None:
    path = tmp_path / "log.nc"
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("obs", 3)
    assert refused(path) == "expected a variable with the standard_name time; there are: none"
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("N_MEASUREMENTS", None)
        file.createVariable("TIME", "f8", ("N_MEASUREMENTS",)).units = "fortnights since the flood"
    assert refused(path) == "expected rows, there are none"
    with netCDF4.Dataset(path, "a") as file:
        file["TIME"][:] = np.arange(3.0)
    assert re.match(r"column 'TIME': expected 'seconds since.*, not 'fortnights since the", refused(path))
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        file.createDimension("N_MEASUREMENTS", 2)
        file.createVariable("BATTPOS", "f8", ("N_MEASUREMENTS",))
    path.write_bytes(path.read_bytes().replace(b"BATTPOS", b"BAT\x96POS"))
    assert refused(path).startswith("expected a whole netCDF file: 'utf-8'")


def test_parquet_of_something_else(tmp_path: Path) -> None:
    """Texts, no times, no rows, other metadata, and zeros that expand beyond measure."""
    zeros = pa.array(np.zeros(4_000_000))
    none = pa.schema([(name, pa.float64()) for name in ("time", *CHANNELS)])
    numbers = pa.table({"time": [1.0, 2.0]})
    tables = {
        "column 'mag_x': expected numbers, not string": pa.table({"time": [1.0], "mag_x": ["north"]}),
        "column 'time': expected this column; there are: mag_x; if one": pa.table({"mag_x": [1.0]}),
        "expected rows, there are none": none.empty_table(),
        "expected a whole Parquet file: 'utf": numbers.replace_schema_metadata({"magbridge": b"\xff"}),
        "expected a whole Parquet file": numbers.replace_schema_metadata({"magbridge": b"{"}),
        "4000000 rows of 9 columns in": pa.table({"time": zeros, **{f"c{k}": zeros for k in range(8)}}),
    }
    for expected, table in tables.items():
        parquet.write_table(table, tmp_path / "log.parquet")
        assert refused(tmp_path / "log.parquet").startswith(expected)


@pytest.mark.parametrize("suffix", [".csv", ".tlog", ".bin", ".ulg"])
@given(content=st.binary(min_size=1, max_size=400))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_a_deployment_or_one_line(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(content)
    try:
        logs.read(path)
    except FormatError as error:
        one_line(error, path)


@pytest.mark.parametrize("suffix", [".nc", ".parquet"])
@settings(max_examples=60, deadline=None, derandomize=True)  # HDF5 itself may not live through any damage
@given(places=st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 255)), min_size=1, max_size=9))
def test_a_damaged_file_is_a_deployment_or_one_line(
    suffix: str, places: list[tuple[int, int]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("damaged") / f"log{suffix}"
    logs.write(deployment("made", np.arange(40.0), {name: np.arange(40.0) for name in CHANNELS}), path)
    content = bytearray(path.read_bytes())
    for place, byte in places:
        content[place % len(content)] = byte
    path.write_bytes(content)
    try:
        assert logs.read(path).sizes["time"]
    except FormatError as error:
        one_line(error, path)


# ---- Damage that once hung or crashed a reader: a result, or one line that names the file ----------------


@pytest.mark.parametrize("tags", ["", "encoding_ver:    5\nnum_ascii_tags:    14\n"])
def test_a_slocums_header_that_is_cut_off(tags: str, tmp_path: Path) -> None:
    path = tmp_path / "a.dbd"
    path.write_text(f"dbd_label:    DBD(dinkum_binary_data)file\n{tags}")
    assert "the header is cut off" in refused(path)


@pytest.mark.parametrize("damaged", [b"sensors_per_cycle", b"state_bytes_per_cycle", b"list of sensors"])
def test_a_damaged_slocum_is_named(damaged: bytes, real_data: Path, tmp_path: Path) -> None:
    flight, cache = tmp_path / "comet-2016-174-05-003.dbd", tmp_path / "11d38bfd.cac"
    for path in (flight, cache):
        path.write_bytes((real_data / "slocum_comet" / path.name).read_bytes())
    if b"list" in damaged:
        lines = cache.read_bytes().splitlines(keepends=True)
        lines[1618] = b"s: T 1618 1618 99999999999999999999999 u\n"
        cache.write_bytes(b"".join(lines))
        with pytest.raises(FormatError, match=r"11d38bfd\.cac: row 1619: expected a sensor"):
            read(flight)
        return
    whole = flight.read_bytes()
    flight.write_bytes(whole.replace(damaged + b":    ", damaged + b":    " + b"9" * 23, 1))
    assert "expected a whole Slocum file" in refused(flight)


@pytest.mark.parametrize("name", ["no_row_group.parquet", "attribute.nc", "hangs.ulg", "short.dbd"])
def test_files_that_once_failed(cases: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each file gives a result or one line, within the processor time of the guard."""
    monkeypatch.setattr(guard, "BASE_TIME_S", 2.0)
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
    """An unclosed quotation mark once made the rest of the file one cell: pandas' ParserError."""
    path = tmp_path / "log.csv"
    rows = [f"{1_700_000_000 + 4 * k},20000.0,{k}.0,40000.0\n" for k in range(20)]
    rows[7] = '1700000028,20000.0,"7.0,40000.0\n'
    path.write_text("time,mag_x,mag_y,mag_z\n" + "".join(rows))
    got = read(path)
    assert got["mag_y"].to_numpy().tolist() == [*range(7), *range(8, 20)]
    rows[7] = '1700000028,20000.0,"7.0",40000.0\n'
    path.write_text("time,mag_x,mag_y,mag_z\n" + "".join(rows))
    assert read(path)["mag_y"].to_numpy().tolist() == list(range(20))
