"""Test the physics of each injected effect, independently of the detector's model."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import effects
import numpy as np
import pytest
import xarray as xr
from effects import EFFECTS, FOREIGN, soaked

import sitl.inject
from magbridge.columns import CHANNELS
from magbridge.errors import ConfigError, WrongUse
from sitl import Twin, load, segments, simulate
from sitl.dataset import channels
from sitl.inject import HiddenEffect, disturb
from sitl.mission import CrissCross, Spirals
from sitl.scenario import SCENARIOS, Scenario
from sitl.trajectory import Track

SIZE = {
    "filter_lag": 0.05,
    "clock_offset": 0.05,
    "channel_skew": 0.01,
    "eddy_current": 0.005,
    "outliers": 40.0,
}
"""Sizes that change the field by about 1 nT; other effects have the size 5 in their own unit."""
DRAWN = {
    "temperature_offset": 129.2, "temperature_scale": 175.3, "offset_step": 156.4, "offset_drift": 115.3,
    "current_field": 92.01, "unmodelled_actuator": 141.9, "actuator_order": 41.53, "hysteresis": 46.32,
    "eddy_current": 38.51, "channel_skew": 287, "filter_lag": 769.7, "clock_offset": 4.762,
    "nonlinearity": 127.1, "saturation": 37.08, "pressure_offset": 107, "diurnal_variation": 5.419,
    "map_error": 160.4, "reference_bias": 172.7, "interference_tone": 141.8, "outliers": 325,
    "relay": 150.2, "ship": 41.03, "pan": 173.9, "loose": 172.4, "corrosion": 156.3, "pulsation": 139.9,
    "needle": 133.7, "thermostat": 109.9, "perming": 26.23, "staircase": 208.7,
    "jettison": 214.7, "duet": 149.1, "winch": 61.43, "mooring": 71.04,
}  # fmt: skip
"""Norm (nT) of what each does to the log of :func:`flight`, as first drawn.

A case of the blind study is equal in every study. A change of an effect's physics or of the order of its
draws requires a new number here, and makes the cases of earlier studies different. The tolerance is that of
the printed digits; another draw changes the first of them.
"""
Flight = tuple[Twin, Track, np.ndarray]


@pytest.fixture(scope="module")
def flight() -> Flight:
    exact = {"corner": 0.0, "channel_delay": (0.0,) * 3, "noise_sigma": 0.0, "bits": 32, "full_scale": 2e5}
    mission = (CrissCross(hours=1.5, duration=600.0),)
    twin = Twin.draw(load("demo").replace(instrument=exact, mission=mission), 4)
    track = twin.fly()
    return twin, track, np.arange(0.0, track.elapsed[-1] - 30.0, 4.0)


@pytest.fixture(scope="module")
def clean(flight: Flight) -> xr.Dataset:
    return seen(flight)


def seen(flight: Flight, *hidden: HiddenEffect) -> xr.Dataset:
    return disturb(flight[0], hidden, *flight[1:], seed=3, effects=EFFECTS | FOREIGN)


def effect(flight: Flight, clean: xr.Dataset, name: str, times: float = 1.0) -> tuple[np.ndarray, xr.Dataset]:
    """Return the change of the channels (n, 3), and the log."""
    ds = seen(flight, HiddenEffect(name, times * SIZE.get(name, 5.0), 11))
    return channels(ds) - channels(clean), ds


def imported(path: Path) -> list[str]:
    """Return the modules that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            names.append(str(node.module))
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return names


def test_it_knows_nothing_of_the_detector() -> None:
    """The injector nothing of the whole package, the simulation below it nothing of a diagnosis."""
    own, other = Path(sitl.inject.__file__), Path(effects.__file__)
    for path in (*own.parent.rglob("*.py"), other):
        forbidden = "magbridge" if path in (own, other) else "magbridge.diagnose"
        assert not [name for name in imported(path) if name.startswith(forbidden)], path


def test_a_filter_shows_a_turning_field_as_it_was(flight: Flight) -> None:
    """Between simulated points a turning field is an arc: its chord, 0.5 nT off, would betray a delay."""
    twin, track, when = flight
    delay, rate = 0.05, 3.0
    still = {name: np.full_like(values, values[0]) for name, values in track.parameters.items()}
    track = replace(track, parameters=still, roll=0.0 * track.roll, pitch=0.0 * track.pitch)
    turning, late = (replace(track, heading=rate * (track.elapsed - t)) for t in (0.0, delay))
    lag = (HiddenEffect("filter_lag", delay, 11),)
    filtered = channels(disturb(twin, lag, turning, when, 3, EFFECTS))
    np.testing.assert_allclose(filtered[1:], channels(disturb(twin, (), late, when, 3))[1:], atol=0.2)


def test_nothing_hidden_is_the_twins_own_measurement(flight: Flight, clean: xr.Dataset) -> None:
    twin, track, when = flight
    np.testing.assert_array_equal(channels(clean), channels(twin.measure(track, when)))


@pytest.mark.parametrize("name", [*EFFECTS, *FOREIGN])
def test_twice_the_size_does_twice_as_much_and_the_seed_decides_the_rest(
    flight: Flight, clean: xr.Dataset, name: str
) -> None:
    def change(times: float) -> np.ndarray:
        own, ds = effect(flight, clean, name, times)
        others = [ds[c] - clean[c] for c in ("reference_field", "battpos", "ballast")]
        return np.column_stack([own, *others])

    one, two = change(1.0), change(2.0)
    assert np.abs(one).max() > 0.05
    assert np.linalg.norm(one) == pytest.approx(DRAWN[name], rel=2e-3)
    assert np.linalg.norm(two - 2.0 * one) < 0.1 * np.linalg.norm(one)
    np.testing.assert_array_equal(change(1.0), one)


def test_a_late_clock_shifts_the_telemetry_only(flight: Flight, clean: xr.Dataset) -> None:
    own, ds = effect(flight, clean, "clock_offset", 20.0)
    assert not own.any()
    _, track, when = flight
    late = json.loads(ds.attrs["truth"])["delay"]
    assert abs(late) == pytest.approx(1.0)
    then = np.interp(when - late, track.elapsed, track.parameters["ballast"])
    assert ds["ballast"].to_numpy()[1:] == pytest.approx(then[1:])


def test_skew_reads_each_channel_in_its_own_time(flight: Flight) -> None:
    size = 0.5  # the simulation's own step
    ds = seen(flight, HiddenEffect("channel_skew", size, 11))
    truth = json.loads(ds.attrs["truth"])
    twin, track, when = flight
    for axis in "xyz":
        later = disturb(twin, (), track, when + truth[axis], 3)
        np.testing.assert_allclose(ds[f"mag_{axis}"], later[f"mag_{axis}"], atol=1e-3)
    assert sorted(truth.values()) == [0.0, size, 2 * size]
    assert not {"mag_time_x", "mag_time_z"} & set(ds.data_vars)  # not in the log


def test_a_ring_couples_across_axes_only(flight: Flight, clean: xr.Dataset) -> None:
    own, ds = effect(flight, clean, "eddy_current")
    truth = json.loads(ds.attrs["truth"])
    rate = np.gradient(channels(clean), 4.0, axis=0)
    # it turns the field of one axis into that of the others
    strongest = max(truth, key=lambda pair: abs(truth[pair]))
    i, j = ("xyz".index(axis) for axis in strongest)
    assert np.corrcoef(own[:, i], rate[:, j])[0, 1] * np.sign(truth[strongest]) > 0.9
    assert np.std(own[:, j]) < 0.2 * np.std(own[:, i])


def test_steel_remembers_where_the_mass_came_from(flight: Flight, clean: xr.Dataset) -> None:
    """At one place it is magnetised one way or the other, by where the mass came from."""
    _, track, _ = flight
    x = track.parameters["battpos"]
    own, _ = effect(flight, clean, "hysteresis")
    at = np.interp(flight[2], track.elapsed, x)
    rising = np.gradient(at) > 1e-3
    falling = np.gradient(at) < -1e-3
    middle = np.abs(at - np.median(at)) < 0.15
    direction = own[np.argmax(np.linalg.norm(own, axis=1))]
    along = own @ direction / np.linalg.norm(direction)
    assert abs(np.mean(along[rising & middle]) - np.mean(along[falling & middle])) > 0.5 * np.std(along)


def test_heat_soaks_in_later_than_one_lag_and_all_the_way() -> None:
    step, lag = 1.0, 500.0
    core = soaked(np.append(np.zeros(10), np.ones(8000)), step, lag)[9:]
    t = step * np.arange(len(core))
    assert core[-1] == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.diff(core) > -0.01)
    # the slab's middle does not feel the face at once; one time constant would be at 1 - exp(-0.1) by then
    assert core[np.searchsorted(t, 0.1 * lag)] < 0.5 * (1.0 - np.exp(-0.1))


# ---- ``[[hidden]]`` in a scenario: what happens to a vehicle after its calibration -----------------------


def short(name: str) -> Scenario:
    """Return a built-in scenario with half an hour of survey."""
    return load(name).replace(mission=(Spirals(duration=120.0), CrissCross(hours=0.5)))


@pytest.mark.parametrize("name", ["bolt", "pump", "battery"])
def test_it_shows_in_its_segment_alone(name: str) -> None:
    """Before, nothing is changed; then, as much as its size allows."""
    scenario = short(name)
    changed = segments(simulate(scenario, 3))
    harmless = scenario.replace(hidden=())
    plain = segments(simulate(harmless, 3))
    for axis in CHANNELS:
        np.testing.assert_array_equal(changed["calibration"][axis], plain["calibration"][axis])
    off = max(
        float(np.abs(changed["survey"][a] - plain["survey"][a]).max()) for a in ("mag_x", "mag_y", "mag_z")
    )
    assert 5.0 < off < 100.0


def test_an_unknown_effect_is_one_line(tmp_path: Path) -> None:
    """The error message names the key and the known effects."""
    text = (SCENARIOS / "bolt.toml").read_text(encoding="utf-8").replace("offset_step", "gremlin")
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"hidden.effect: expected one of offset_step.* not gremlin"):
        load(tmp_path / "mine.toml")


def test_a_segment_that_is_not_flown_is_refused() -> None:
    """An effect without a place would be no effect."""
    scenario = load("bolt").replace(mission=(Spirals(duration=120.0),))
    with pytest.raises(WrongUse, match="no segment 'survey'"):
        simulate(scenario, 1)
