"""A Slocum's segments, made by hand after the format that dbdreader reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from segments import CRC, segment

from magbridge import logs
from magbridge.errors import FormatError
from magbridge.logs.deployment import named_losses, passed_over

dbdreader = pytest.importorskip("dbdreader")

T0 = 1_704_067_200.0


def flight(n: int = 50, start: float = T0) -> dict[str, np.ndarray]:
    k = np.arange(float(n))
    return {
        "m_present_time": start + 4.0 * k,
        "m_depth": 0.5 * k,
        "m_battpos": np.cos(k),
        "m_pitch": 0.4 * np.sin(k),
    }


def science(n: int = 50) -> dict[str, np.ndarray]:
    k = np.arange(float(n))
    started = k > 3
    return {
        "sci_m_present_time": T0 + 1.0 + 4.0 * k,
        "sci_water_temp": np.where(started, 9.0 + 0.01 * k, 0.0),
        "sci_water_pressure": np.where(started, 0.05 * k, 0.0),
    }


def test_every_column_is_dbdreaders(tmp_path: Path) -> None:
    segment(tmp_path / "a.sbd", flight())
    segment(tmp_path / "a.tbd", science())
    back = logs.read(tmp_path / "a.sbd")
    other = dbdreader.DBD(str(tmp_path / "a.sbd"))
    for theirs, ours, factor in (
        ("m_depth", "depth", 1.0), ("m_battpos", "battpos", 1.0), ("m_pitch", "pitch", 180.0 / np.pi),
    ):  # fmt: skip
        when, what = other.get(theirs)
        np.testing.assert_array_equal(np.interp(back["time"], when, what * factor), back[ours])
    assert back.sizes["time"] == 49  # dbdreader leaves the first cycle out: it repeats earlier values


def test_what_a_science_computer_starts_with_was_not_measured(tmp_path: Path) -> None:
    segment(tmp_path / "a.sbd", flight())
    segment(tmp_path / "a.tbd", science())
    back = logs.read(tmp_path / "a.tbd")
    assert (back["water_temperature"] > 9.0).all()
    assert float(back["water_pressure"].min()) == 0.05 * 4


def test_a_temperature_of_zero_at_depth_is_one(tmp_path: Path) -> None:
    measured = science() | {"sci_water_temp": np.zeros(50)}
    segment(tmp_path / "a.tbd", measured)
    back = logs.read(tmp_path / "a.tbd")
    assert (back["water_temperature"] == 0.0).all()


@pytest.mark.parametrize("folder", [".", "cac", "../cac", "cache"])
def test_the_list_of_sensors_may_be_in_a_folder(folder: str, tmp_path: Path) -> None:
    logged = tmp_path / "logs"
    logged.mkdir()
    segment(logged / "a.sbd", flight(), factored=True)
    (logged / folder).mkdir(exist_ok=True)
    (logged / f"{CRC}.cac").rename(logged / folder / f"{CRC}.cac")
    assert logs.read(logged / "a.sbd")["battpos"].notnull().all()


def test_an_empty_segment_costs_itself(tmp_path: Path) -> None:
    for k, n in enumerate((50, 1, 50)):
        segment(tmp_path / f"{k}.sbd", flight(n, T0 + 1000.0 * k))
    back = logs.read(sorted(tmp_path.iterdir()))
    assert back.sizes["time"] == 98
    assert passed_over(back.attrs) == {"files_skipped": 1}
    assert named_losses(back.attrs) == [f"{tmp_path / '1.sbd'}: expected rows, there are none"]
    with pytest.raises(FormatError, match=r"1\.sbd: expected rows, there are none"):
        logs.read(tmp_path / "1.sbd")
