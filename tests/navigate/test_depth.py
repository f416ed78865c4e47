"""Test the options' errors of map and level, and navigation on a map above a diving vehicle."""

from __future__ import annotations

from dataclasses import replace as changed
from math import hypot

import numpy as np
import pytest
import xarray as xr
from msgspec.structs import replace
from voyages import GLIDER, Map, dived, sail, synthetic, track_over

from magbridge.calibration.model import Noise, Reference, identity
from magbridge.cli.navigate import _continued
from magbridge.field.continuation import continued, smoothed
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.options import NavigationOptions, at_depth, informed, lasting_errors


def test_errors_of_the_map_add_up() -> None:
    drawn = synthetic(Map(30, 1500), 3)
    flown = AnomalyGrid(drawn.longitude, drawn.latitude, drawn.anomaly, altitude=90.0)
    depth, options = (
        np.append(np.linspace(0.0, 120.0, 50), np.nan),
        NavigationOptions(map_sigma=1.5, map_length=800.0),
    )
    there, known = at_depth(flown, options, depth)
    left = continued(flown, depth[:-1])
    assert there.altitude == pytest.approx(-60.0)
    assert known.map_sigma == pytest.approx(hypot(1.5, left.sigma))
    assert min(left.length, 800.0) < known.map_length < max(left.length, 800.0)
    assert at_depth(drawn, options, depth) == (drawn, options), "an unknown altitude"


@pytest.mark.parametrize(
    ("depth", "texts"), [(60.0, "60 m below the surface"), (-60.0, "60 m above the surface")]
)
def test_a_level_is_reported_on_its_side_of_the_surface(
    depth: float, texts: str, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = synthetic(Map(30, 1500), 3)
    flown = AnomalyGrid(drawn.longitude, drawn.latitude, drawn.anomaly, altitude=90.0)
    _continued(flown, NavigationOptions(), xr.Dataset({"depth": ("time", [depth] * 9)}))
    assert f"continued to {texts}" in capsys.readouterr().err


def test_a_glider_that_dives_under_it_is_found() -> None:
    """Taken for the field below it, the map leads the filter away; continued to the depth, it does not."""
    flown, below = dived(2)
    assert below["error"] < 0.2 * flown["error"]
    assert below["nees"] < 2.0
    assert below["valid"] > 0.5


def test_what_lies_between_nodes_counts_as_map_error() -> None:
    """Sources at the depth of the node spacing: some nT between the nodes, over half their distance."""
    rng, n = np.random.default_rng(7), 60
    k = 2.0 * np.pi * np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n))
    values = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) * np.exp(-k)).real
    axis = 0.01 * np.arange(n)
    coarse = AnomalyGrid(10.0 + axis, 54.0 + axis, values * 100.0 / values.std())
    there, known = at_depth(coarse, NavigationOptions(map_sigma=0.0), 0.0)
    assert there is coarse
    assert known.map_sigma == pytest.approx(coarse.interpolation_sigma)
    assert known.map_sigma > 1.0
    assert known.map_length == pytest.approx(0.5 * coarse.spacing)


def test_a_map_whose_level_is_uncertain_leaves_the_bias_open() -> None:
    surveyed = synthetic(Map(40, 1000), 0).replaced(level_sigma=100.0)
    there, known = lasting_errors(surveyed, NavigationOptions(bias_sigma=5.0))
    assert known.bias_sigma == pytest.approx(hypot(100.0, 5.0))
    assert lasting_errors(there, known) == (there, known), "counted once"


def test_what_was_smoothed_away_is_a_map_error_that_lasts_and_a_flight_holds_its_position() -> None:
    """A rough field without its waves below 1 km: near the bound, consistent; counted with every measurement
    instead, a field that has nothing to do with the map explained the flight better, and it was lost.
    """
    raw = synthetic(Map(40, 1000, rough=True), 0)
    less = smoothed(raw, 1_000.0)
    lasting, known = lasting_errors(less, NavigationOptions(map_sigma=0.0))
    assert known.map_sigma == pytest.approx(float(np.std(less.anomaly - raw.anomaly)), rel=0.3)
    assert known.map_length == pytest.approx(less.sigma_length)
    assert lasting.error(4.0 * known.map_sigma**2)[0] == pytest.approx(2.0)
    assert lasting_errors(lasting, known) == (lasting, known), "counted once"
    assert lasting_errors(raw, known) == (raw, known)
    options = replace(GLIDER, start_sigma=150.0)
    flown = sail(track_over(raw, options, 1000, hours=3.0), less, options).score()
    assert not flown["lost"]
    assert flown["drms"] < 2.0 * flown["bound"] < flown["unaided"]
    assert flown["nees"] < 3.0


def test_level_is_a_bias_that_lasts() -> None:
    """It widens the bias, whose changes stay as large as before: 2 sigma²/tau."""
    plain = changed(identity(), noise=Noise(1.0))
    levelled = changed(plain, reference=Reference(50_000.0, "IGRF", 0.0, 145.0, 150.0))
    without = informed(NavigationOptions(), plain, 2.0)
    known = informed(NavigationOptions(), levelled, (2.0**2 + 150.0**2) ** 0.5)
    assert known.noise == without.noise
    assert known.bias_sigma == pytest.approx((without.bias_sigma**2 + 150.0**2) ** 0.5)
    assert known.bias_sigma**2 / known.bias_time == pytest.approx(without.bias_sigma**2 / without.bias_time)
