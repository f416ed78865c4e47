"""A column called ``$\\frac{$`` is drawn as it is called."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import msgspec
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from magbridge.arrays import plain
from magbridge.logs.draw import draw_corrected
from magbridge.pictures import literal


def test_a_name_is_not_read_as_mathematics() -> None:
    figure = Figure()
    axis = figure.subplots()
    axis.plot([1.0, 1e6], [1.0, 1e6], label=r"$\frac{$")
    axis.set_xscale("log")
    axis.set_title(r"$\frac{$")
    axis.legend()
    with pytest.raises(ValueError, match=r"ParseException|Expected"):
        figure.savefig(BytesIO())
    literal(figure)
    figure.savefig(BytesIO())
    assert axis.get_xticklabels()[0].get_parse_math()


def test_a_log_of_any_name_is_drawn(tmp_path: Path) -> None:
    columns = ("total_field", "total_field_sigma", "anomaly", "quality")
    log = xr.Dataset({name: ("time", np.arange(3.0)) for name in columns}, {"time": np.arange(3.0)})
    draw_corrected(log.assign_attrs(source=r"$\frac{$.nc"), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_numpys_numbers_are_encoded() -> None:
    assert msgspec.json.encode({"a": np.float64(0.5), "b": np.int64(3)}, enc_hook=plain) == b'{"a":0.5,"b":3}'
    with pytest.raises(NotImplementedError):
        msgspec.json.encode({"a": object()}, enc_hook=plain)
