"""Pictures for notebooks: drawn on the axes given, or on new ones, with the numbers in them."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib as mpl
import numpy as np
import pytest
from demos import demo_log
from matplotlib.figure import Figure

import magbridge as mb
from magbridge.calibration.fitting.observations import Observations
from magbridge.field.grid import AnomalyGrid

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


def test_a_notebook_shows_a_fit_with_its_warnings() -> None:
    fit = mb.fit(mb.observations(log, ("battpos", "ballast")))
    shown = fit._repr_html_()
    assert "&lt;Fit: " in shown
    assert fit.warnings
    assert shown.count("<li>") == len(fit.warnings)


def test_a_corrected_log(found: tuple[mb.Calibration, Observations]) -> None:
    corrected = mb.correct_rows(mb.Correction(found[0]), log)
    axes = Figure().subplots()
    assert mb.plot.corrected(corrected, ax=axes) is axes
    line = np.asarray(axes.lines[0].get_ydata())
    good = np.isfinite(line)
    np.testing.assert_array_equal(line[good], corrected["total_field"].to_numpy()[good])
    assert "nT" in mb.plot.corrected(corrected, "total_field_sigma").get_ylabel()
    with pytest.raises(mb.MagbridgeError, match="no column 'total_field': correct it first"):
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


def test_what_a_notebook_shows_is_a_line(found: tuple[mb.Calibration, Observations]) -> None:
    fit = mb.fit(found[1], method="nominal")
    for one in (fit, fit.calibration):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 200
    assert "nominal" in repr(fit)
