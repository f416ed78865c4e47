"""Test that bad rows are dropped, counted and named, and the other rows are read as without them."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import Command
from hypothesis import given
from hypothesis import strategies as st

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.checks import checked, in_order
from magbridge.logs.deployment import LOSSES_ATTRIBUTE, deployment, named_losses, noted, passed_over

T0 = 1.7e9


def counted(time: np.ndarray, rows: int = 1000) -> tuple[list[float], dict[str, int], list[str]]:
    """Check a log with these times; return the remaining times, the counts and the messages."""
    whole = deployment("log.csv", time, {"mag_x": np.arange(float(len(time)))})
    starts = range(0, len(time), rows)
    pieces = [(whole.isel(time=slice(k, k + rows)), range(k + 1, k + 1 + rows)) for k in starts]
    sound = list(checked("log.csv", pieces))
    attrs = [piece.attrs for piece in sound]
    return [t for piece in sound for t in piece["time"].values], passed_over(*attrs), named_losses(*attrs)


@pytest.mark.parametrize("rows", [100, 1000])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e14, -2.6e9, T0 + 400 * 86400.0, T0 - 400 * 86400.0])
@pytest.mark.parametrize("place", [0, 57, 99, 100, 299])
def test_one_damaged_time_costs_its_row(wrong: float, place: int, rows: int) -> None:
    time = T0 + np.arange(300.0)
    damaged = time.copy()
    damaged[place] = wrong
    left, counts, (line,) = counted(damaged, rows)
    assert left == np.delete(time, place).tolist()
    assert counts == {"rows_dropped": 1}
    assert line.startswith(f"log.csv: row {place + 1}, column 'time': expected ")


def test_a_clock_set_back_costs_what_it_lives_through_twice() -> None:
    left, counts, _ = counted(T0 + np.r_[np.arange(100.0), np.arange(92.5, 200.0)])
    assert counts == {"rows_dropped": 7}
    assert len(left) == 201
    assert (np.diff(left) > 0).all()


def test_rows_at_one_time_become_one() -> None:
    time = T0 + np.array([0.0, 1, 1, 1, 2, 3, 4, 5])
    x, y = np.array([0.0, np.nan, 7, 8, 2, 3, 4, 5]), np.array([0.0, 1, np.nan, 9, 2, 3, 4, 5])
    whole = deployment("log.csv", time, {"x": x, "y": y})
    (read,) = checked("log.csv", [(whole, range(1, 9))])
    assert read["time"].values.tolist() == (T0 + np.arange(6.0)).tolist()
    assert read["x"].values.tolist() == [0, 7, 2, 3, 4, 5]
    assert read["y"].values.tolist() == [0, 1, 2, 3, 4, 5]
    assert passed_over(read.attrs) == {"duplicate_rows": 2}


def text(path: Path, start: float, x: np.ndarray) -> Path:
    """Write a log with a row per second and two columns."""
    rows = [f"{start + k},{value},{-value}" for k, value in enumerate(x)]
    path.write_text("\n".join(["time,mag_x [nT],mag_y [nT]", *rows]))
    return path


def both_ways(paths: list[Path], date: float | None = None, *, strict: bool = False) -> list[xr.Dataset]:
    """Return the logs as a whole, and joined from pieces."""
    options = logs.Options(strict=strict, date=date)
    pieces = list(logs.read_chunks(paths, 30, options=options))
    streamed = xr.concat(pieces, "time", combine_attrs="drop")
    counts = passed_over(*(piece.attrs for piece in pieces))
    streamed.attrs = {**counts, LOSSES_ATTRIBUTE: "\n".join(named_losses(*(p.attrs for p in pieces)))}
    return [logs.read(paths, options=options), streamed]


@pytest.mark.parametrize("date", [None, T0])
def test_files_that_count_from_two_boots_are_two_runs(tmp_path: Path, date: float | None) -> None:
    """As a restart inside one file; a file that goes on with the same rows is no other boot."""
    x = np.linspace(2e4, 3e4, 100)
    paths = [text(tmp_path / "a.csv", 5.0, x), text(tmp_path / "b.csv", 0.25, x[::-1])]
    for one in both_ways(paths, date):
        time = one["time"].values - (date or 0.0)
        np.testing.assert_allclose(time, np.r_[5.0 + np.arange(100), 164.0 + np.arange(100)], atol=1e-5)
        assert one["mag_x"].values.tolist() == [*x, *x[::-1]]
        assert passed_over(one.attrs) == {}
    assert noted(logs.read(paths).attrs)[0].startswith("b.csv: counts from another boot")
    goes_on = text(tmp_path / "c.csv", 65.0, np.r_[x[60:], x])
    for one in both_ways([paths[0], goes_on]):
        assert one.sizes["time"] == 200
        assert passed_over(one.attrs) == {"duplicate_rows": 40}


def test_rows_of_equal_times_but_other_values_are_no_duplicates(tmp_path: Path) -> None:
    x = np.linspace(2e4, 3e4, 100)
    paths = [text(tmp_path / "a.csv", T0, x), text(tmp_path / "b.csv", T0 + 80.0, np.r_[x[80:90], x[:40]])]
    for one in both_ways(paths):
        assert one.sizes["time"] == 130
        assert one["mag_x"].values[:100].tolist() == x.tolist()
        assert passed_over(one.attrs) == {"contradictory_rows": 10, "duplicate_rows": 10}
        assert any("b.csv: " in line and " of a.csv" in line for line in named_losses(one.attrs))
    with pytest.raises(FormatError, match=r"contradictory_rows, as --strict .* b\.csv: 10 .* a\.csv"):
        logs.read(paths, options=logs.Options(strict=True))


def test_strict_refuses_rows_that_two_files_repeat(tmp_path: Path) -> None:
    """But not rows that complete each other."""
    x, strict = np.linspace(2e4, 3e4, 100), logs.Options(strict=True)
    paths = [text(tmp_path / "a.csv", T0, x), text(tmp_path / "b.csv", T0 + 80.0, x[80:])]
    for read in (logs.read, logs.read_chunks):
        with pytest.raises(FormatError, match=r"a\.csv, b\.csv: expected logs without"):
            list(read(paths, options=strict))
    lines = [f"{T0 + k},{k}" for k in range(100)]
    (tmp_path / "d.csv").write_text("\n".join(["time,depth [m]", *lines]))
    for one in both_ways([paths[0], tmp_path / "d.csv"], strict=True):
        assert one.sizes["time"] == 100


@given(time=st.lists(st.integers(0, 9), max_size=12))
def test_no_longer_series_of_times_could_be_kept(time: list[int]) -> None:
    best = [1] * len(time)
    for k, now in enumerate(time):
        best[k] += max((best[j] for j in range(k) if time[j] <= now), default=0)
    if time:
        series = np.flatnonzero(in_order(np.array(time, float), strictly=False))
        assert len(series) == max(best)
        assert (np.diff(series) > 0).all()
        assert (np.diff(np.array(time)[series]) >= 0).all()


def made(folder: Path, n: int, bad: tuple[int, ...]) -> list[Path]:
    """Write a deployment of `n` files, some of which are not logs."""
    paths = [folder / f"{k:03}.csv" for k in range(n)]
    for k, path in enumerate(paths):
        rows = deployment("made", T0 + 10.0 * k + np.arange(10.0), {"mag_x": np.full(10, float(k))})
        logs.write(rows, path)
        if k in bad:
            path.write_text("time,mag_x\n")
    return paths


def test_three_bad_files_of_forty(tmp_path: Path) -> None:
    paths = made(tmp_path, 40, (0, 17, 39))
    bad = [paths[k] for k in (0, 17, 39)]
    whole = logs.read(paths)
    pieces = list(logs.read_chunks(paths, 30))
    for attrs in ([whole.attrs], [piece.attrs for piece in pieces]):
        assert passed_over(*attrs) == {"files_skipped": 3}
        assert named_losses(*attrs) == [f"{path}: row 2: expected rows after the header" for path in bad]
    assert whole.sizes["time"] == sum(piece.sizes["time"] for piece in pieces) == 370
    with pytest.raises(FormatError, match=r"000\.csv"):
        logs.read(paths, options=logs.Options(strict=True))
    for read in (logs.read, logs.read_chunks):
        with pytest.raises(FormatError, match="expected rows after the header"):
            list(read(bad))


def test_a_file_that_breaks_off_is_read_up_to_there(tmp_path: Path) -> None:
    """The file's end is not text: the rows before it are kept, and the file is counted and named."""
    paths = made(tmp_path, 3, ())
    long = deployment("made", T0 + 10.0 + np.arange(0.0, 10.0, 0.001), {"mag_x": np.ones(10_000)})
    logs.write(long, paths[1])
    paths[1].write_bytes(paths[1].read_bytes() + b"\xff\x00" * 5_000)
    pieces = list(logs.read_chunks(paths, 1000))
    assert 9_000 <= sum(piece.sizes["time"] for piece in pieces) - 20 <= 10_000
    assert passed_over(*(piece.attrs for piece in pieces)) == {"files_skipped": 1}
    named = [line for piece in pieces for line in named_losses(piece.attrs)]
    assert named == [f"{paths[1]}: expected text in UTF-8"]


def test_what_was_lost_is_reported_in_a_few_lines(tmp_path: Path, command: Command) -> None:
    paths = made(tmp_path, 12, tuple(range(1, 9)))
    lines = command("convert", *paths, "-o", tmp_path / "x.nc").err.splitlines()
    assert lines[0] == "magbridge: in the logs: 8 files skipped"
    assert lines[1] == f"magbridge: {paths[1]}: row 2: expected rows after the header"
    assert lines[-1] == "magbridge: and in 3 places more"
    assert len(lines) == 7
    assert not {"losses", "files_skipped"} & logs.read(tmp_path / "x.nc").attrs.keys()


def test_a_file_is_what_its_bytes_say(tmp_path: Path) -> None:
    rows = deployment("made", T0 + np.arange(5.0), {"mag_x": np.arange(5.0)})
    for suffix in (".mcap", ".nc", ".parquet", ".tlog"):
        logs.write(rows, tmp_path / f"log{suffix}")
        (tmp_path / f"log{suffix}").rename(tmp_path / "log.dat")
        np.testing.assert_array_equal(logs.read(tmp_path / "log.dat")["mag_x"], rows["mag_x"])


def test_a_date_moves_times_that_count_from_the_boot(tmp_path: Path) -> None:
    time = 5.0 + np.arange(5.0)
    rows = deployment("made", time, {"mag_x": np.arange(5.0), "mag_time_x": time})
    logs.write(rows, tmp_path / "log.nc")
    read = logs.read(tmp_path / "log.nc", options=logs.Options(date=T0))
    assert read["time"].values.tolist() == (T0 + 5.0 + np.arange(5.0)).tolist()
    np.testing.assert_array_equal(read["mag_time_x"], read["time"])
    logs.write(read, tmp_path / "dated.nc")
    again = logs.read(tmp_path / "dated.nc", options=logs.Options(date=0.0))
    np.testing.assert_array_equal(again["time"], read["time"])


# ---- what a log says it was made from ----------------------------------------------------------------------


def test_a_log_rewritten_again_and_again_names_itself_and_where_it_began(tmp_path: Path) -> None:
    logs.write(deployment("comet, driven by (old) p.nc", [1.0], {}), tmp_path / "a.nc")
    logs.write(logs.read(tmp_path / "a.nc"), tmp_path / "ba.nc")
    logs.write(logs.read(tmp_path / "ba.nc"), tmp_path / "c.parquet")
    assert logs.read(tmp_path / "c.parquet").attrs["source"] == "c.parquet (comet, driven by (old) p.nc)"
    (tmp_path / "a.nc").unlink()
    (tmp_path / "ba.nc").rename(tmp_path / "a.nc")  # within the other's name
    assert logs.read(tmp_path / "a.nc").attrs["source"] == "a.nc (comet, driven by (old) p.nc)"
