"""A log whose times count from the boot has no date, and so no Earth's field."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magbridge.errors import FormatError
from magbridge.field.reference import earth_field, main_field, reference_field, with_true_heading

N = 5


def log(start: float, **attrs: str) -> xr.Dataset:
    columns = {"latitude": 47.0, "longitude": -52.0, "heading": 10.0}
    return xr.Dataset(
        {name: ("time", np.full(N, value)) for name, value in columns.items()},
        coords={"time": start + np.arange(float(N))},
        attrs={"source": "flight.BIN", **attrs},
    )


UNDATED = [log(0.0), log(1.7e9, time_reference="boot"), log(3e8)]


@pytest.mark.parametrize("undated", UNDATED)
def test_there_is_no_field_of_1970(undated: xr.Dataset) -> None:
    for compute in (reference_field, earth_field):
        with pytest.raises(
            FormatError, match=r"flight\.BIN: its times count from the boot.* --date YYYY-MM-DD"
        ):
            compute(undated)
    with pytest.raises(FormatError, match="--date"):
        with_true_heading(undated, "magnetic")
    assert np.isnan(main_field(undated)).all()


@pytest.mark.parametrize("undated", UNDATED)
def test_a_reference_of_its_own_needs_no_date(undated: xr.Dataset) -> None:
    known = undated.assign(reference_field=("time", np.full(N, 5e4)))
    total, vector, name = earth_field(known)
    assert total.tolist() == [5e4] * N
    assert vector is None
    assert name == "reference_field"


def test_a_log_with_a_date_has_its_field() -> None:
    assert np.isfinite(main_field(log(1.7e9))).all()
    assert reference_field(log(1.7e9)) == pytest.approx(reference_field(log(1.7e9, time_reference="utc")))
