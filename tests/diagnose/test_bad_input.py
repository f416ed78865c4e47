"""Test that `diagnose` reports an unusable deployment in one line that names the required column."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from demos import demo
from machine import full_disk

from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.model import CalibratedSensor, Calibration
from magbridge.diagnose.assessment import DiagnosisResult
from magbridge.diagnose.report import page
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import load_survey
from magbridge.errors import DataError, WriteError
from magbridge.field.geodesy import offset, wrap

Plain = tuple[xr.Dataset, Calibration]
Found = tuple[DiagnosisResult, Path]


@pytest.fixture(scope="module")
def plain() -> Plain:
    return demo().survey, demo().calibration


def some(ds: xr.Dataset, count: int) -> xr.DataArray:
    """Return a mask (n,) that is False for the first samples."""
    return ds["time"] >= ds["time"][count]


@pytest.fixture(scope="module")
def found(plain: Plain, tmp_path_factory: pytest.TempPathFactory) -> Found:
    """Return a diagnosis and the folder to which it was written."""
    folder = tmp_path_factory.mktemp("found")
    return diagnose([plain[0]], plain[1], folder, remarks=["a<b>.csv: fitted to this log"]), folder


def test_the_demonstrations_survey_is_plain(found: Found) -> None:
    """The report and the findings also state the properties of the log."""
    assert found[0].diagnosis.verdict == "nothing_found"
    remarks = json.loads((found[1] / "findings.json").read_text())["remarks"]
    assert remarks == ["a<b>.csv: fitted to this log"]
    assert "a&lt;b&gt;.csv: fitted to this log.</p>" in (found[1] / "report.html").read_text()


def test_a_full_disk_names_the_file_that_has_no_room(found: Found, tmp_path: Path) -> None:
    sizes = {path.name: path.stat().st_size for path in found[1].iterdir()}
    largest = sizes.pop("report.html")
    enough = max(sizes.values())
    assert largest > 1.05 * enough
    for room, name in ((0, "calibration.json"), (enough, "report.html")):
        with (
            full_disk(room),
            pytest.raises(WriteError, match=rf"doubt/{name}: cannot be written: File too large"),
        ):
            page.write(found[0], tmp_path / "doubt")
        assert not list(tmp_path.iterdir())


def test_how_old_a_parameter_was_is_not_telemetry(plain: Plain) -> None:
    """A bridge's log has the age of a parameter, to which the field cannot respond."""
    aged = plain[0].assign(age_battpos=plain[0]["time"] % 3.0)
    assert load_survey([aged], plain[1]).channels.keys() == load_survey([plain[0]], plain[1]).channels.keys()


def test_a_sample_that_is_given_twice_is_one(plain: Plain) -> None:
    ds, calibration = plain
    again = np.sort([*range(ds.sizes["time"]), *range(5, 500, 20)])
    once, twice = load_survey([ds], calibration), load_survey([ds.isel(time=again)], calibration)
    for name in ("time", "field", "reference", "steps", "dive"):
        np.testing.assert_array_equal(getattr(once, name), getattr(twice, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda ds: ds.drop_vars(["reference_field", "latitude", "longitude"]),
            "latitude and longitude, or reference_field",
        ),
        (
            lambda ds: ds.drop_vars("reference_field").assign(latitude=np.nan * ds["latitude"]),
            "latitude and longitude, or reference_field",
        ),
        (lambda ds: ds.drop_vars("battpos"), "column 'battpos': expected this column"),
        (lambda ds: ds.isel(time=slice(0, 3)), "3 samples, at least 60"),
        (lambda ds: ds.assign(mag_y=ds["mag_y"] * np.nan), "'mag_y' has 0 numbers"),
        (lambda ds: ds.assign({f"mag_{a}": 0.0 * ds[f"mag_{a}"] + 2e4 for a in "xyz"}), "never change"),
        (lambda ds: ds.assign({f"mag_{axis}": 1e-5 * ds[f"mag_{axis}"] for axis in "xyz"}), "expected nT"),
        (lambda ds: ds.assign(battpos=100.0 * ds["battpos"]), "'battpos' is .* expected its unit"),
        (lambda ds: ds.assign(ballast=ds["ballast"].where(some(ds, 40), -9999.0)), "'ballast' is -9999"),
        (lambda ds: ds.assign_attrs(sensor="another"), "sensor 'one', the calibration's, got 'another'"),
    ],
)
def test_one_line(plain: Plain, change: Callable[[xr.Dataset], xr.Dataset], message: str) -> None:
    calibration = replace(plain[1], sensor=CalibratedSensor("one"))
    with pytest.raises(DataError, match=message) as caught:
        diagnose([change(plain[0])], calibration)
    assert "\n" not in str(caught.value)


def test_an_effects_channel_that_holds_nothing_is_reported_to_be_empty(plain: Plain) -> None:
    ds, calibration = plain
    warm = ChannelEffect(cause="temperature_offset", channel="warmth")
    extended = replace(
        calibration,
        effects=(warm,),
        coefficients=np.append(calibration.coefficients, np.zeros(3)),
        covariance=np.pad(calibration.covariance, (0, 3)),
    )
    with pytest.raises(DataError, match="column 'warmth', which is missing or empty"):
        diagnose([ds.assign(warmth=np.nan * ds["battpos"])], extended)


def test_a_log_given_twice_is_refused(plain: Plain) -> None:
    with pytest.raises(DataError, match="given twice"):
        diagnose([plain[0]], plain[1], training_logs=[plain[0].copy()])


def test_a_hundred_samples_are_few_but_enough(plain: Plain) -> None:
    assert diagnose([plain[0].isel(time=slice(0, 100))], plain[1]).diagnosis.verdict == "nothing_found"


def test_telemetry_that_stands_still_is_not_telemetry(plain: Plain) -> None:
    ds = plain[0]
    still = ds.assign({name: 0.0 * ds[name] + ds[name].mean() for name in ("sensor_temperature", "depth")})
    found = diagnose([still], plain[1]).diagnosis
    assert {"temperature_offset", "pressure_offset"} <= set(found.isolability.untestable)


def test_attitude_and_position_may_be_lacking_in_some_rows_or_all(plain: Plain) -> None:
    """An autopilot's log begins before its first attitude; a reference is there without a position."""
    ds, calibration = plain
    late = {name: ds[name].where(some(ds, 9)) for name in ("roll", "pitch", "heading")}
    never = {name: np.nan * ds[name] for name in ("latitude", "longitude", "depth")}
    survey = load_survey([ds.assign(late | never)], calibration)
    assert survey.attitude is not None
    assert np.isfinite(survey.attitude).all()
    assert survey.place is None
    assert load_survey([ds.assign(roll=np.nan * ds["roll"])], calibration).attitude is None
    assert diagnose([ds.assign(late | never)], calibration).diagnosis.verdict == "nothing_found"


def test_a_track_across_the_date_line_is_one_track(plain: Plain) -> None:
    ds, calibration = plain
    moved = wrap((ds["longitude"] - ds["longitude"].mean()).to_numpy() + 180.0)
    assert moved.min() < -179.0 < 179.0 < moved.max()
    there, here = (
        load_survey([one], calibration).place for one in (ds.assign(longitude=("time", moved)), ds)
    )
    np.testing.assert_allclose(there, here, atol=1e-4)


def test_a_place_is_in_metres_on_the_ellipsoid(plain: Plain) -> None:
    """On a sphere, positions would be wrong by 56 m in 10 km at the equator."""
    ds, calibration = plain
    track = np.linspace([-5e3, 10e3], [5e3, -10e3], ds.sizes["time"])
    latitude, longitude = offset(0.0, 10.0, *track.T)
    survey = load_survey([ds.assign(latitude=("time", latitude), longitude=("time", longitude))], calibration)
    track = track[np.isin(ds["time"], survey.time)]
    assert survey.place is not None
    np.testing.assert_allclose(survey.place[:, :2], track - np.median(track, axis=0), atol=0.1)


def test_another_magnetometer_is_not_telemetry(plain: Plain) -> None:
    """A second magnetometer would explain any change of the Earth's field."""
    ds, calibration = plain
    both = ds.assign(second=ds["mag_x"].assign_attrs(units="nT"))
    assert "second" not in load_survey([both], calibration).channels


def test_a_channel_that_repeats_its_reading_is_known_where_it_was_read(plain: Plain) -> None:
    """A time that occurs twice has no slope, so that no row was complete."""
    ds, calibration = plain
    time = ds["time"].to_numpy()
    sampled = time + 0.02
    sampled[1::2] = sampled[::2][: len(sampled[1::2])]
    late = {f"mag_time_{axis}": ("time", sampled) for axis in "z"}
    survey = load_survey([ds.assign(late)], calibration)
    assert len(survey.time) > 0.3 * len(time)
