"""Whether a track tells what changes with the place from what changes with time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from posed import FIELD, T0, calibrated, right, surveyed
from reported import section
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose.assessment import separation
from magbridge.diagnose.observed import Returns, returns
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from sitl.signals import correlated

N = 1350
ALONG = np.linspace(0.0, 1.0, N)
UNITS = dict.fromkeys(("roll", "pitch", "heading", "latitude", "longitude"), "deg") | {"depth": "m"}
TRACKS: dict[str, FloatArray] = {
    "away": 9000.0 * ALONG,
    "there and back": 9000.0 * (1.0 - np.abs(2.0 * ALONG - 1.0)),
    "to and fro, eight times": 2000.0 * np.abs((8.0 * ALONG) % 2.0 - 1.0),
}


def flown(north: FloatArray) -> Returns:
    """Return the known positions of a track of four hours along a meridian, m."""
    survey = replace(
        right(N).survey, time=T0 + 14400.0 * ALONG, place=np.stack([north, 0.0 * north, 0.0 * north], axis=1)
    )
    found = returns(survey)
    assert found is not None
    return found


def test_a_log_without_positions_says_nothing() -> None:
    assert returns(surveyed(np.ones((N, 3)), ALONG)) is None


def test_only_returns_at_several_times_tell_place_from_time() -> None:
    away, back, fro = (flown(track) for track in TRACKS.values())
    assert away.share == away.longest == 0.0
    assert "never returns" in separation(away).text
    assert back.share > 0.8
    assert back.longest == pytest.approx(14400.0, rel=0.05)
    assert (
        max(away.separable, back.separable) < 0.01
    )  # what bends about the turning point is the same on both ways
    assert "cannot be distinguished" in separation(back).text
    assert fro.separable > 0.5
    assert fro.distinguishable
    assert "can be distinguished" in separation(fro).text


@pytest.mark.parametrize("name", TRACKS)
def test_the_share_is_what_no_function_of_the_place_imitates(name: str) -> None:
    """By brute force: of all trends with a bend the one that the cells' means explain best."""
    cell = np.floor(TRACKS[name] / 250.0)
    G = (cell[:, None] == np.unique(cell)).astype(float)
    least = np.inf
    trend, bend = ALONG - 0.5, (ALONG - 0.5) ** 2
    trend, bend = (x / np.std(x) - np.mean(x) / np.std(x) for x in (trend, bend))
    for angle in np.linspace(0.0, np.pi, 181):
        f = np.cos(angle) * trend + np.sin(angle) * bend
        residual = f - G @ np.linalg.lstsq(G, f, rcond=None)[0]
        least = min(least, float(np.var(residual) / np.var(f)))
    assert flown(TRACKS[name]).separable == pytest.approx(least, abs=2e-3)


def logged(hidden: str, track: str) -> xr.Dataset:
    """Return six hours of a vehicle that dives along a track, with one effect hidden in the log."""
    rng = np.random.default_rng(1)
    north, hours = TRACKS[track], 6.0 * ALONG
    pitch = 0.4 * np.sign(np.sin(np.arange(N) / 13.0)) + 0.1 * rng.normal(size=N)
    heading = np.pi * (np.gradient(north) < 0.0) + 0.3 * rng.normal(size=N)
    roll = 0.2 * rng.normal(size=N)
    u = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=1)).inv().apply([0.35, 0.05, 0.935])
    noise = rng.normal(size=(N, 3))
    reference, offset = np.full(N, FIELD), np.zeros((N, 3))
    if hidden == "map_error":
        reference += 3.0 * (np.sin(north / 700.0 + 2.0) + np.cos(north / 310.0))
    elif hidden == "diurnal_variation":
        reference += 12.0 * np.cos(2.0 * np.pi * hours / 24.0 - 2.0)
        noise = correlated(noise, 0.9)
    else:
        offset = np.outer(ALONG > 0.6, [0.6, 0.2, 0.77])
    field = FIELD * u / np.linalg.norm(u[0]) + offset + noise
    angles = np.degrees([roll, pitch, heading % (2.0 * np.pi)])
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), field.T, strict=True))
    columns |= dict(zip(("roll", "pitch", "heading"), angles, strict=True))
    columns |= {
        "reference_field": reference, "latitude": 45.0 + north / 111_200.0, "longitude": np.full(N, -60.0),
        "depth": 40.0 - 35.0 * np.cos(np.arange(N) / 13.0),
    }  # fmt: skip
    ds = xr.Dataset({k: ("time", v) for k, v in columns.items()}, {"time": T0 + 3600.0 * hours})
    for name, column in ds.data_vars.items():
        column.attrs["units"] = UNITS.get(str(name), "nT")
    return ds.assign_attrs(source="made")


@pytest.mark.parametrize(
    ("hidden", "track"),
    [
        ("map_error", "to and fro, eight times"),
        ("diurnal_variation", "away"),
        ("offset_step", "there and back"),
    ],
)
def test_one_hidden_cause_gets_one_name_and_alternatives_where_the_track_cannot_decide(
    hidden: str, track: str
) -> None:
    """A small step, a map's error, and a daily variation under autoregressive noise."""
    known = replace(calibrated(np.zeros(9), 1e-2), parameters=(), terms=(Polynomial(exponents=((),)),))
    found = diagnose([logged(hidden, track)], known)
    facts = findings(found)
    (one,) = facts["findings"]
    others = [other["cause"] for other in one["alternatives"]] if track == "away" else []
    assert hidden in [one["cause"], *others]
    output = facts["assessment"]["spatial_temporal"]
    assert output["distinguishable"] == (track == "to and fro, eight times")
    codes = [one["code"] for one in facts["assessment"]["reasons_against"]]
    assert ("spatial_temporal" in codes) == (hidden == "diurnal_variation" and track == "away")
    assert output["text"] in section(found.diagnosis, "What this log could have shown")
