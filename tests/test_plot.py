"""Test the plots for notebooks: drawn on given or new axes, with the right values."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import msgspec
import numpy as np
import pytest
import xarray as xr
from demos import demo_log
from matplotlib.figure import Figure

import magbridge as mb
from magbridge.arrays import plain
from magbridge.calibration.fitting.observations import Observations
from magbridge.field.grid import AnomalyGrid
from magbridge.pictures import literal
from magbridge.plot import draw_corrected

mpl.use("Agg")
log = demo_log()


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    from matplotlib import pyplot  # noqa: PLC0415 - after use()

    pyplot.close("all")


@pytest.fixture(scope="module")
def found() -> tuple[mb.Calibration, Observations]:
    data = mb.observations(log, "battpos")
    return mb.fit(data, method="nominal").calibration, data


def test_a_notebook_shows_a_fit_as_a_line_with_its_warnings() -> None:
    fit = mb.fit(mb.observations(log, ("battpos", "ballast")))
    shown = fit._repr_html_()
    assert "&lt;Fit: " in shown
    assert fit.warnings
    assert shown.count("<li>") == len(fit.warnings)
    for one in (fit, fit.calibration):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 200
    assert fit.calibration.method in repr(fit)


def test_a_corrected_log(found: tuple[mb.Calibration, Observations]) -> None:
    corrected = mb.correct_rows(mb.Correction(found[0]), log)
    axes = Figure().subplots()
    assert mb.plot.corrected(corrected, ax=axes) is axes
    line = np.asarray(axes.lines[0].get_ydata())
    good = np.isfinite(line)
    np.testing.assert_array_equal(line[good], corrected["total_field"].to_numpy()[good])
    assert "nT" in mb.plot.corrected(corrected, "total_field_sigma").get_ylabel()
    decoded = corrected.assign_coords(time=corrected["time"].to_numpy().astype("datetime64[s]"))
    shown = mb.plot.corrected(decoded).lines[0].get_xdata()
    np.testing.assert_array_equal(np.asarray(shown), np.asarray(axes.lines[0].get_xdata()))
    with pytest.raises(mb.MagbridgeError, match=r"expected a column 'total_field'.*correct the log first"):
        mb.plot.corrected(log)


@pytest.mark.parametrize(
    ("against", "label"), [("time", "minutes"), ("heading", "deg"), ("battpos", "battpos, in")]
)
def test_residuals(against: str, label: str, found: tuple[mb.Calibration, Observations]) -> None:
    axes = mb.plot.residuals(*found, against=against)
    assert label in axes.get_xlabel()
    assert np.size(axes.lines[0].get_ydata()) == len(found[1])


def test_residuals_against_nothing(found: tuple[mb.Calibration, Observations]) -> None:
    with pytest.raises(mb.MagbridgeError, match="against: expected one of time, heading, battpos"):
        mb.plot.residuals(*found, against="moon")


def test_a_grid_with_a_track() -> None:
    grid = AnomalyGrid(np.linspace(-58, -57, 4), np.linspace(49, 50, 4), np.arange(16.0).reshape(4, 4))
    axes = mb.plot.grid(grid, log)
    assert np.size(axes.lines[0].get_xdata()) == log.sizes["time"]
    assert axes.collections[0].get_array().max() == 15.0


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
