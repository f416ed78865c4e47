"""Data frames in and out: what a notebook has."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from demos import demo_log

import magbridge as mb


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
