"""Test that every written format can be read back, whole or in pieces."""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from demos import demo_log
from hypothesis import given, settings
from hypothesis import strategies as st

import magbridge as mb
from magbridge import datasets, logs
from magbridge.columns import CHANNEL_TIMES, COLUMNS
from magbridge.logs.checks import MAX_CHANNEL_DELAY_S, MAX_MAGNITUDE, MIN_VALUE, REFERENCE_FIELD_RANGE_NT
from magbridge.logs.deployment import deployment

EXACT = [".csv", ".nc", ".parquet", ".mcap"]
WRITABLE = [*EXACT, ".tlog"]
T0 = 1_466_705_388.010925
UNITS = {"battpos": "in", "ballast": "cc", "pump_current": "A", "a_rather_long_name": "degC", "ratio": "1"}
UNITS |= {"BattPos": "in"}

known = st.lists(st.sampled_from([name for name in COLUMNS if name not in ("time", "quality")]), unique=True)
others = st.dictionaries(
    st.from_regex(r"[A-Za-z][A-Za-z0-9_.]{0,20}", fullmatch=True).filter(lambda name: name not in COLUMNS),
    st.sampled_from(["A", "in", "1", "degC", "m/s"]),
    max_size=4,
)


@st.composite
def deployments(draw: st.DrawFn, width: Literal[32, 64]) -> xr.Dataset:
    """Columns of the table and of any other name, NaN anywhere; µs that fit what a record can say."""
    steps = draw(st.lists(st.integers(1, 10**8), min_size=1, max_size=12))
    time = (1_700_000_000_000_000 + np.cumsum(steps)) / 1e6
    units = draw(others)
    columns = {}
    for name in [*draw(known), *units]:
        most = MAX_MAGNITUDE.get(name, MAX_CHANNEL_DELAY_S / 2 if name in CHANNEL_TIMES else None)
        least = MIN_VALUE.get(COLUMNS[name].units if name in COLUMNS else units[name])
        bounds = (
            {"min_value": least and int(least)} if most is None else {"min_value": -most, "max_value": most}
        )
        if name == "reference_field":
            bounds = {"min_value": REFERENCE_FIELD_RANGE_NT[0], "max_value": REFERENCE_FIELD_RANGE_NT[1]}
        value = st.floats(**bounds, allow_infinity=False, width=width) | st.just(np.nan)
        column = np.array(draw(st.lists(value, min_size=len(time), max_size=len(time))), dtype=float)
        columns[name] = time + column if name in CHANNEL_TIMES else column
    flags = st.sampled_from([0, 1, 3, 128, 255])
    columns["quality"] = np.array(draw(st.lists(flags, min_size=len(time), max_size=len(time))), dtype=float)
    return deployment(
        "made", time, columns, units, draw(st.sampled_from([{}, {"heading_reference": "magnetic"}]))
    )


def example(rows: int = 100, start: float = T0, seed: int = 0) -> xr.Dataset:
    """Return a glider's telemetry, each value as a vehicle would have it."""
    random = np.random.default_rng(seed)
    time = np.round(start + 4.0 * np.arange(rows), 6)
    columns = {f"mag_{axis}": random.normal(0, 30_000, rows) for axis in "xyz"}
    columns |= {f"mag_time_{axis}": np.round(time + k * 0.01, 6) for k, axis in enumerate("xyz")}
    columns |= {"roll": random.uniform(-40, 40, rows), "pitch": random.uniform(-30, 30, rows)}
    columns |= {"heading": random.uniform(0, 360, rows), "latitude": random.uniform(-90, 90, rows)}
    columns |= {"longitude": random.uniform(-180, 180, rows), "depth": random.uniform(0, 1000, rows)}
    columns |= {"sensor_temperature": random.uniform(-2, 30, rows), "power_cycle": np.full(rows, 3.0)}
    columns |= {"total_field": random.normal(50_000, 100, rows)}
    columns |= {"total_field_sigma": random.uniform(1, 9, rows)}
    columns |= {f"field_{axis}": random.normal(0, 30_000, rows) for axis in "xyz"}
    columns |= {"anomaly": random.normal(0, 50, rows), "quality": random.integers(0, 256, rows).astype(float)}
    columns |= {name: random.normal(0, 3, rows) for name in UNITS}
    for name in ("battpos", "roll", "latitude", "sensor_temperature", "anomaly", "a_rather_long_name"):
        columns[name][random.uniform(size=rows) < 0.2] = np.nan
    return deployment("made", time, columns, UNITS, {"heading_reference": "magnetic"})


TOLERANCES = {"latitude": 0.6e-7, "longitude": 0.6e-7, "depth": 0.6e-3, "heading": 5e-5, "total_field": 0.0}


def assert_close(back: xr.Dataset, dataset: xr.Dataset, *, exact: bool = False) -> None:
    """Assert equality, unless `exact` to the precision of the messages: float32, 1e-7 deg, mm, µs."""
    assert set(back.data_vars) == set(dataset.data_vars)
    for name, column in dataset.variables.items():
        atol = TOLERANCES.get(str(name), 0.6e-6 if "time" in str(name) else 1e-30)
        rtol = 0.0 if name in TOLERANCES or "time" in str(name) else 1.3e-7
        rtol, atol = (0.0, 0.0) if exact else (rtol, atol)
        np.testing.assert_allclose(back[name].values, column.values, rtol, atol, err_msg=str(name))
        assert back[name].attrs == column.attrs
    assert back.attrs.get("heading_reference") == dataset.attrs.get("heading_reference")


@pytest.mark.parametrize("suffix", EXACT)
@given(dataset=deployments(width=64))
@settings(max_examples=25, deadline=None)
def test_comes_back_bit_for_bit(suffix: str, dataset: xr.Dataset) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, f"log{suffix}")
        logs.write(dataset, path)
        assert_close(logs.read(path), dataset, exact=True)


@given(dataset=deployments(width=32))
@settings(max_examples=25, deadline=None)
def test_any_numbers_pass_through_a_telemetry_log(dataset: xr.Dataset) -> None:
    """Numbers that no vehicle has may come back as unknown, but nothing breaks and time stands."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "log.tlog")
        logs.write(dataset, path)
        back = logs.read(path)
    np.testing.assert_allclose(back["time"], dataset["time"], rtol=0, atol=0.6e-6)
    for name in set(dataset.data_vars) - set(COLUMNS):
        np.testing.assert_array_equal(back[name], dataset[name], err_msg=name)
        assert back[name].attrs == dataset[name].attrs


@pytest.mark.parametrize("suffix", WRITABLE)
def test_in_pieces_is_as_whole(suffix: str, tmp_path: Path) -> None:
    dataset = example()
    whole, pieces = tmp_path / f"whole{suffix}", tmp_path / f"pieces{suffix}"
    logs.write(dataset, whole)
    with logs.Writer(pieces) as writer:
        for piece in logs.read_chunks(whole, 17):
            assert piece.sizes["time"] <= 17
            assert set(piece.data_vars) == set(dataset.data_vars)
            writer.append(piece)
    assert_close(logs.read(pieces), dataset)


@pytest.mark.parametrize("suffix", WRITABLE)
def test_a_later_piece_may_lack_a_column(suffix: str, tmp_path: Path) -> None:
    first, second = example(5), example(5, start=T0 + 100)
    with logs.Writer(tmp_path / f"log{suffix}") as writer:
        writer.append(first)
        writer.append(second.drop_vars(["battpos", "pitch"]))
    back = logs.read(tmp_path / f"log{suffix}")
    assert back.sizes["time"] == 10
    assert np.isnan(back["battpos"][5:]).all()
    assert np.isnan(back["pitch"][5:]).all()
    assert not np.isnan(back["pitch"][:5]).all()
    refused = pytest.raises(ValueError, match=r"column 'battpos': expected only columns that the first rows")
    with refused, logs.Writer(tmp_path / f"log{suffix}") as writer:
        writer.append(first.drop_vars("battpos"))
        writer.append(second)


@pytest.mark.parametrize("suffix", WRITABLE)
def test_what_fails_leaves_the_old_file(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_text("old")
    backwards = rf"log\{suffix}: row 1, column 'time': expected a time after"
    with pytest.raises(ValueError, match=backwards), logs.Writer(path) as writer:  # noqa: PT012
        writer.append(example(5))
        writer.append(example(5))
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_several_files_are_one_deployment(tmp_path: Path) -> None:
    """Parts in any order and format, overlapping, each with a column of its own."""
    whole = example(60)
    whole["battpos"][:] = np.arange(60.0)
    whole["ballast"][:] = -np.arange(60.0)
    logs.write(whole.isel(time=slice(0, 25)).drop_vars("battpos"), tmp_path / "a.parquet")
    logs.write(whole.isel(time=slice(20, 40)), tmp_path / "b.nc")
    logs.write(whole.isel(time=slice(40, 60)).drop_vars("ballast"), tmp_path / "c.csv")
    paths = [tmp_path / "c.csv", tmp_path / "a.parquet", tmp_path / "b.nc"]
    back = logs.read(paths)
    assert back.attrs["source"].split(", ")[0] == "c.csv"
    assert back.attrs["duplicate_rows"] == 5
    np.testing.assert_array_equal(back["time"], whole["time"])
    np.testing.assert_array_equal(back["mag_x"], whole["mag_x"])
    np.testing.assert_array_equal(back["battpos"], np.r_[np.full(20, np.nan), np.arange(20.0, 60.0)])
    np.testing.assert_array_equal(back["ballast"], np.r_[-np.arange(40.0), np.full(20, np.nan)])
    for rows in (1, 7, 1000):
        pieces = list(logs.read_chunks(paths, rows))
        assert {piece.attrs["source"] for piece in pieces} == {back.attrs["source"]}
        assert len(pieces) <= -(-65 // rows)
        for name in back.variables:
            streamed = np.concatenate([piece[name].values for piece in pieces])
            np.testing.assert_array_equal(streamed, back[name].values, err_msg=str(name))


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("heading", "heading [deg magnetic]", "expected heading_reference true as before, not magnetic"),
        ("battpos [in]", "battpos [cm]", "column 'battpos': expected 'in' as in the files before, not 'cm'"),
    ],
)
def test_files_that_disagree_are_not_mixed(first: str, second: str, expected: str, tmp_path: Path) -> None:
    for name, heading, start in (("a", first, 0), ("b", second, 10)):
        (tmp_path / f"{name}.csv").write_text(f"time,{heading}\n{start},1\n")
    with pytest.raises(ValueError, match=f"b.csv: {expected}"):
        logs.read([tmp_path / "a.csv", tmp_path / "b.csv"])


def test_streams_in_bounded_memory(tmp_path: Path) -> None:
    """Eight times the rows need as much memory: the reader keeps only one piece of constant size."""
    import tracemalloc  # noqa: PLC0415 - slows everything down while it is loaded

    peaks = []
    for pieces in (2, 16):
        with logs.Writer(tmp_path / "in.nc") as writer:
            for k in range(pieces):
                writer.append(example(200, start=T0 + 1e4 * k))
        tracemalloc.start()
        with logs.Writer(tmp_path / "out.csv") as writer:
            for piece in logs.read_chunks(tmp_path / "in.nc", 200):
                writer.append(piece)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0] + 200_000


@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".mcap"])
def test_a_first_row_that_lacks_most_values_is_a_row(suffix: str, tmp_path: Path) -> None:
    """The columns need not say what they mean, either."""
    whole = example(20)
    for name in whole.data_vars:
        del whole[name].attrs["long_name"]
        if not str(name).startswith("mag_"):
            whole[name][0] = np.nan
    logs.write(whole, tmp_path / f"a{suffix}")
    back = logs.read(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back["mag_x"], whole["mag_x"])
    assert back["time"][0] == whole["time"][0]


def test_mcap_is_what_foxglove_opens(tmp_path: Path) -> None:
    """Foxglove's own reader finds the topics, schemas and messages."""
    reader = pytest.importorskip("mcap.reader")
    whole = example(50).fillna(2.0)
    whole["latitude"][7] = np.nan
    whole["quality"][9] = 2 + 128
    logs.write(whole, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        found = [
            (schema, channel, message.log_time, json.loads(message.data))
            for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages()
        ]
    counts = Counter(channel.topic for _, channel, _, _ in found)
    topics = dict.fromkeys(("/magnetometer", "/field", "/quality", "/vehicle", "/telemetry"), 50)
    assert counts == {**topics, "/position": 49}
    for schema, channel, stamp, body in found:
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        output = json.loads(schema.data)
        assert (output["type"], output["title"]) == ("object", schema.name)
        assert body.keys() <= output["properties"].keys()
        assert stamp == body["timestamp"]["sec"] * 10**9 + body["timestamp"]["nsec"]
    first = {channel.topic: body for _, channel, _, body in reversed(found)}
    fix = first["/position"]
    assert {schema.name for schema, channel, _, _ in found if channel.topic == "/position"} == {
        "foxglove.LocationFix"
    }
    assert (fix["latitude"], fix["altitude"]) == (whole["latitude"][0], -whole["depth"][0])
    assert first["/field"]["total_field"] == whole["total_field"][0]
    flags = [body for _, channel, _, body in found if channel.topic == "/quality"][9]
    assert [name for name, value in flags.items() if value is True] == ["extrapolated", "gap"]


def test_a_height_is_the_opposite_of_the_depth_by_every_way_in(tmp_path: Path) -> None:
    """At 4,000 m it changes the main field by 90 nT; a height above the ground does not count."""
    k = np.arange(3)
    place = {"latitude": 40.0 + 0.0 * k, "longitude": 3.0 + 0.0 * k}
    frame = pd.DataFrame({"time": 1.7e9 + k, **place, "altitude [m]": 4000.0 + k})
    truth = mb.reference_field(mb.from_frame(frame.assign(depth=-4000.0 - k)))
    frame.to_csv(tmp_path / "a.csv", index=False)
    frame.to_parquet(tmp_path / "a.parquet")
    named = {"altitude": 1.0, "gps_height": 1.0, "alt_ft": 1 / 0.3048, "z": 1.0}
    raw = {
        name: xr.Dataset(
            {key: ("time", values) for key, values in place.items()} | {name: ("time", scale * (4000.0 + k))},
            {"time": ("time", 1.7e9 + k, {"units": "seconds since 1970-01-01", "standard_name": "time"})},
        )
        for name, scale in named.items()
    }
    raw["z"]["z"].attrs = {"standard_name": "height_above_mean_sea_level", "units": "meters"}
    raw["z"].to_netcdf(tmp_path / "a.nc")
    files = [logs.read(tmp_path / f"a{suffix}") for suffix in (".csv", ".parquet", ".nc")]
    for log in (*files, mb.from_frame(frame), *raw.values()):
        np.testing.assert_allclose(mb.reference_field(log), truth, atol=1e-6)
        assert "as height above the sea" in datasets.in_standard_units(log).attrs["guessed"]
    raw["alt_ft"].to_netcdf(tmp_path / "b.nc")
    declared = logs.read(tmp_path / "b.nc", options=logs.Options(column=("depth=alt_ft",)))
    np.testing.assert_allclose(declared["depth"], -4000.0 - k)
    assert "as height above the sea" in declared.attrs["guessed"]
    for standard in ("height", "height_above_sea_floor"):
        raw["altitude"]["altitude"].attrs = {"standard_name": standard, "units": "m"}
        raw["altitude"].to_netcdf(tmp_path / "b.nc")
        for log in (raw["altitude"], logs.read(tmp_path / "b.nc")):
            assert "depth" not in datasets.in_standard_units(log)
            assert "altitude" in log


# ---- data frames in and out --------------------------------------------------------------------------------


def test_there_and_back_keeps_every_number_and_unit() -> None:
    log = demo_log().isel(time=slice(0, 50))
    frame = mb.to_frame(log)
    assert str(frame.index.tz) == "UTC"
    back = mb.from_frame(frame, frame.attrs)
    assert set(back) == set(log)
    np.testing.assert_allclose(back["time"], log["time"], atol=1e-6)  # a data frame's moments are in us
    for name in log:
        np.testing.assert_array_equal(back[name], log[name])
        assert back[name].attrs["units"] == log[name].attrs["units"]


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns", "ns, Europe/Berlin", "int64"])
def test_times_of_any_unit_in_parquet_are_exact(unit: str, tmp_path: Path) -> None:
    """float64 counts s since 1970 in steps of 0.24 us; a serial number may have more digits than it keeps."""
    k = np.arange(50)
    times = 1.7e9 + (k if unit == "s" else k / 8.0)
    moments = pd.Series(pd.to_datetime(np.round(times * 1e3), unit="ms"))
    if unit == "int64":
        stamps = moments.astype("datetime64[ns]").astype(np.int64)
    else:
        stamps = moments.astype(f"datetime64[{unit[:2].strip(',')}]")
    if "Berlin" in unit:
        stamps = stamps.dt.tz_localize("UTC").dt.tz_convert("Europe/Berlin")
    frame = pd.DataFrame({"time": stamps, "mag_x": 2e4 + k, "serial": (1 << 60) + k})
    frame.to_parquet(tmp_path / "a.parquet")
    log = logs.read(tmp_path / "a.parquet")
    np.testing.assert_allclose(log["time"], times, rtol=0.0, atol=5e-7 if unit == "int64" else 0.0)
    mb.to_frame(log).astype({"mag_x": int}).to_parquet(tmp_path / "b.parquet")
    np.testing.assert_allclose(logs.read(tmp_path / "b.parquet")["time"], times, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    "time",
    [
        [1.7e9, 1.7e9 + 1],
        ["2023-11-14T22:13:20Z", "2023-11-14T22:13:21Z"],
        pd.to_datetime(["2023-11-14 22:13:20", "2023-11-14 22:13:21"]),
        pd.to_datetime(["2023-11-14 23:13:20", "2023-11-14 23:13:21"]).tz_localize("Europe/Berlin"),
    ],
    ids=["seconds", "texts", "moments", "moments with a zone"],
)
@pytest.mark.parametrize("index", [False, True], ids=["column", "index"])
def test_time_as_users_have_it(time: list[object], index: bool) -> None:
    frame = pd.DataFrame({"mag_x [uT]": [16.0, 17.0], "battpos [in]": [1.0, 2.0]})
    frame = frame.set_index(pd.Index(time)) if index else frame.assign(time=time)
    log = mb.from_frame(frame, heading_reference="magnetic")
    np.testing.assert_array_equal(log["time"], [1.7e9, 1.7e9 + 1])
    np.testing.assert_allclose(log["mag_x"], [16_000.0, 17_000.0])
    assert log["battpos"].attrs["units"] == "in"
    assert log.attrs["heading_reference"] == "magnetic"


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (pd.DataFrame({"mag_x": [1.0]}), "column 'time': expected a column or an index of times"),
        (pd.DataFrame({"time": [1.0], "mag_x": ["a"]}), "column 'mag_x': expected numbers"),
        (pd.DataFrame({"time": [1.0], "mag_x [m]": [1.0]}), "column 'mag_x': expected nT, not m"),
    ],
    ids=["no time", "texts", "unit"],
)
def test_a_frame_that_is_not_a_log(frame: pd.DataFrame, line: str) -> None:
    with pytest.raises(mb.MagbridgeError, match=f"the data frame: {line}"):
        mb.from_frame(frame)


# ---- what must not be there --------------------------------------------------------------------------------


def run(script: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_slocum_leaves_the_home_alone(tmp_path: Path) -> None:
    pytest.importorskip("dbdreader")
    assert run("import os, magbridge.logs.slocum; print(os.environ['HOME'])", HOME=str(tmp_path)) == str(
        tmp_path
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [
        (".parquet", "pyarrow", "formats"),
        (".ulg", "pyulog", "formats"),
        (".dbd", "dbdreader", "formats"),
        (".nc", "netCDF4", "analysis"),
        (".mcap", "rosbags", "ros"),
    ],
)
def test_a_missing_extra_is_named(suffix: str, package: str, extra: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(b"x")
    script = f"""
import sys
sys.modules[{package!r}] = None
from magbridge import logs
from magbridge.errors import MissingExtra
try:
    logs.read({str(path)!r})
except MissingExtra as error:
    print(error)
"""
    assert re.fullmatch(rf"{package} is not installed: pip install '.+\[{extra}\]'", run(script))


def test_a_package_can_bring_a_format(tmp_path: Path) -> None:
    """An entry point: the suffix, and a module with ``chunks``."""
    info = tmp_path / "other-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[magbridge.formats]\nother = other_format\n")
    (tmp_path / "other_format.py").write_text(
        "from magbridge.logs.deployment import deployment\n"
        "def chunks(path, rows):\n    yield deployment(path, [1.0], {'mag_x': [float(path.read_text())]})\n"
    )
    (tmp_path / "log.other").write_text("5")
    script = f"from magbridge import logs; print(logs.read({str(tmp_path / 'log.other')!r})['mag_x'].item())"
    assert run(script, PYTHONPATH=str(tmp_path)) == "5.0"
