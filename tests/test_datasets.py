"""Test logs that enter from Python: their units, the order of their times, and what is not a log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from demos import demo_log

import magbridge as mb
from magbridge.calibration.model import Parameter, identity

LOG = demo_log().isel(time=slice(0, 200))
INCHES = identity((Parameter("battpos", "in", 0.0, 1.0, -1.0, 1.0),))
"""Calibration that leaves readings unchanged, with a parameter in inches."""
TAKERS: dict[str, Callable[[xr.Dataset], object]] = {
    "correct_rows": lambda log: mb.correct_rows(mb.Correction(INCHES), log),
    "correct": lambda log: mb.correct(INCHES, log),
    "observations": lambda log: mb.observations(log, "battpos"),
    "calibrate": lambda log: mb.calibrate(log, "battpos"),
    "diagnose": lambda log: mb.diagnose([log], INCHES),
    "survey": lambda log: mb.survey([log], INCHES),
    "navigate": lambda log: mb.navigate(log.assign(total_field=log["reference_field"])),
    "plan": lambda log: mb.plan(INCHES, log, runs=1),
    "from_frame": lambda log: mb.from_frame(mb.to_frame(log)),
}
"""Public functions that take a log whose times must increase."""


def in_unit(name: str, unit: str, scale: float) -> xr.Dataset:
    """Return the log with a column in another unit, of which `scale` are one standard unit."""
    return LOG.assign({name: (LOG[name] * scale).assign_attrs(units=unit)})


@pytest.mark.parametrize(
    ("unit", "scale"),
    [
        *(("uT", 1e-3), ("\N{MICRO SIGN}T", 1e-3), ("\N{GREEK SMALL LETTER MU}T", 1e-3)),
        *(("mT", 1e-6), ("gauss", 1e-5), ("T", 1e-9)),
    ],
)
def test_a_field_in_another_unit_is_converted(unit: str, scale: float) -> None:
    log = LOG
    for name in ("mag_x", "mag_y", "mag_z", "reference_field"):
        log = log.assign({name: (LOG[name] * scale).assign_attrs(units=unit)})
    for take in (TAKERS["correct_rows"], TAKERS["correct"]):
        expected, found = take(LOG), take(log)
        assert isinstance(expected, xr.Dataset)
        assert isinstance(found, xr.Dataset)
        np.testing.assert_allclose(found["total_field"], expected["total_field"], rtol=1e-9)
    seen, converted = mb.observations(LOG), mb.observations(log)
    np.testing.assert_allclose(converted.field, seen.field, rtol=1e-9)
    np.testing.assert_allclose(converted.reference, seen.reference, rtol=1e-9)


@pytest.mark.parametrize("take", ["correct_rows", "correct", "diagnose", "survey", "plan"])
def test_a_parameter_in_another_unit_is_refused(take: str) -> None:
    with pytest.raises(mb.MagbridgeError, match="'battpos': expected 'in', the calibration's unit, not 'mm'"):
        TAKERS[take](in_unit("battpos", "mm", 25.4))


@pytest.mark.parametrize(
    ("unit", "other_unit"),
    [
        *(("cm3", other) for other in ("mL", "ml", "cm**3", "cm^3", "cc")),
        *(("in", "inches"), ("in", "Inches"), ("A", "amps"), ("mm", "millimetres"), ("degC", "deg C")),
    ],
)
def test_equal_spellings_of_a_unit(unit: str, other_unit: str) -> None:
    known = identity((Parameter("battpos", unit, 0.0, 1.0, -1.0, 1.0),))
    mb.correct_rows(mb.Correction(known), in_unit("battpos", other_unit, 1.0))


def shuffled() -> xr.Dataset:
    return LOG.isel(time=np.random.default_rng(2).permutation(LOG.sizes["time"]))


@pytest.mark.parametrize("take", TAKERS)
def test_times_must_increase(take: str) -> None:
    backwards = LOG.isel(time=slice(None, None, -1))
    with pytest.raises(mb.MagbridgeError, match="expected times that increase, they run backwards: sort the"):
        TAKERS[take](backwards)
    repeated = xr.concat([LOG.isel(time=slice(0, 3)), LOG.isel(time=slice(2, None))], "time")
    for log in (shuffled(), repeated):
        with pytest.raises(mb.MagbridgeError, match=r"row \d, column 'time': expected"):
            TAKERS[take](log)


@pytest.mark.parametrize("unit", ["s", "seconds since 1970-01-01", "days since 2020-02-29T12:00:00", "ms"])
def test_numbers_of_time_in_a_declared_unit(unit: str) -> None:
    start = 1_582_977_600.0 if "2020" in unit else 0.0
    each = {"d": 86_400.0, "m": 1e-3}.get(unit[0], 1.0)
    values = (LOG["time"].to_numpy() - start) / each
    log = LOG.assign_coords(time=("time", values, {"units": unit}))
    np.testing.assert_allclose(mb.observations(log).time, LOG["time"], atol=1e-6)


def test_a_file_that_xarray_wrote_is_read_back(tmp_path: Path) -> None:
    LOG.to_netcdf(tmp_path / "x.nc")
    for back in (mb.read(tmp_path / "x.nc"), xr.open_dataset(tmp_path / "x.nc")):
        seen = mb.observations(back, "battpos")
        np.testing.assert_array_equal(seen.time, LOG["time"])
        np.testing.assert_array_equal(seen.field, mb.observations(LOG, "battpos").field)


SEEN = mb.observations(LOG, "battpos")
FRAME = mb.to_frame(LOG)
FIELDS = np.full((9, 3), 3e4)
WRONG_ARGUMENTS: dict[str, tuple[Callable[..., object], tuple[object, ...], dict[str, object], str]] = {
    "no file": (mb.read, ([],), {}, "paths: expected at least one file, got none"),
    "absent file": (mb.read, ("none.csv",), {}, "none.csv: expected a file, there is none"),
    "absent calibration": (mb.load, ("none.json",), {}, "none.json: expected a file, there is none"),
    "absent grid": (mb.read_grid, ("none.nc",), {}, "none.nc: expected a file, there is none"),
    "no folder": (mb.save, (INCHES, "none/x.json"), {}, "none/x.json: cannot be written"),
    "no folder of a log": (mb.write, (LOG, "none/x.nc"), {}, "none/x.nc: cannot be written"),
    "no log to survey": (mb.survey, ([],), {}, "deployments: expected at least one Dataset, got none"),
    "no log to diagnose": (mb.diagnose, ([], INCHES), {}, "expected at least one"),
    "no time": (mb.correct, (INCHES, LOG.rename(time="when")), {}, "column 'time': expected this column"),
    "misspelt column": (mb.observations, (LOG, "batpos"), {}, "did you mean battpos"),
    "misspelt method": (mb.fit, (SEEN, "nomnal"), {}, "did you mean nominal"),
    "no path": (mb.read, (None,), {}, "paths: expected a path or a sequence of paths, got None"),
    "no paths": (mb.read, ([None],), {}, r"paths: expected a path or a sequence of paths, got \[None\]"),
    "frame": (mb.correct_rows, (mb.Correction(INCHES), FRAME), {}, "got DataFrame; convert it with"),
    "frame to correct": (mb.correct, (INCHES, FRAME), {}, "log: expected an xarray.Dataset, got DataFrame"),
    "frame to observe": (mb.observations, (FRAME,), {}, "log: expected an xarray.Dataset, got DataFrame"),
    "text for numbers": (mb.correct, (INCHES, "abc"), {}, "field, channels: expected numbers"),
    "rows of channels": (mb.correct, (INCHES, FIELDS, FIELDS[:5, :1]), {}, r"expected shape \(9, 1\) for"),
    "channels in rows": (mb.correct, (INCHES, FIELDS, FIELDS[:, :1].T), {}, r"expected shape \(9, 1\) for"),
    "number for names": (mb.observations, (LOG, 5), {}, "parameters: expected names of columns, got 5"),
    "mapping": (mb.observations, ({"time": [0.0]},), {}, "log: expected an xarray.Dataset, got dict"),
    "calibration": (mb.correct_rows, (INCHES, LOG), {}, "correction: expected a Correction, as"),
    "path of a correction": (mb.Correction, ("cal.json",), {}, "calibration: expected a Calibration"),
    "observations to save": (mb.save, (SEEN, "x.json"), {}, "expected a Calibration, .* got Obs"),
    "components first": (mb.heading, (np.ones((3, 4)), 0.0, 0.0), {}, r"expected shape \(n, 3\), got"),
    "path": (mb.correct, ("cal.json", LOG), {}, r"calibration: expected a Calibration, as .*load.* got str"),
    "path of a plan": (mb.plan, ("cal.json", LOG), {}, "calibration: expected a Calibration"),
    "path of a survey": (mb.survey, ([LOG], "cal.json"), {}, "calibrations: expected a Calibration"),
    "path of a diagnosis": (mb.diagnose, ([LOG], "cal.json"), {}, "calibration: expected a Calibration"),
    "log": (mb.fit, (LOG,), {}, "data: expected an Observations, as .*observations.* got Dataset"),
    "misspelt option": (mb.fit, (SEEN,), {"postion_sigma": 1.0}, "did you mean position_sigma"),
    "order 0": (mb.fit, (SEEN,), {"order": 0}, "order: expected a whole number from 1 to 6, got 0"),
    "order -3": (mb.fit, (SEEN,), {"order": -3}, "order: expected a whole number from 1 to 6, got -3"),
    "order 1.5": (mb.fit, (SEEN,), {"order": 1.5}, "order: expected a whole number from 1 to 6, got 1.5"),
    "unknown bias": (mb.fit, (SEEN,), {"site_bias": np.nan}, "site_bias: expected a number from 0 to"),
    "negative bias": (mb.calibrate, (LOG,), {"site_bias": -5.0}, "site_bias: expected a number from 0 to"),
    "text": (mb.fit, (SEEN,), {"site_bias": "5"}, "site_bias: expected a number from 0 to 100000, got '5'"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("function", "arguments", "options", "message"), WRONG_ARGUMENTS.values(), ids=WRONG_ARGUMENTS
)
def test_a_wrong_argument_is_named_in_one_line(
    function: Callable[..., object], arguments: tuple[object, ...], options: dict[str, object], message: str
) -> None:
    with pytest.raises(mb.MagbridgeError, match=message) as caught:
        function(*arguments, **options)
    assert "\n" not in str(caught.value)
