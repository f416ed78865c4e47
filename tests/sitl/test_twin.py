"""Test deployments of the digital twin: scenarios, seeds, missions and logs that drive it."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import xarray as xr

from magbridge import logs
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.file import save as save_calibration
from magbridge.calibration.model import Calibration, Parameter, identity
from magbridge.errors import ConfigError, FormatError, WrongUse
from magbridge.field.igrf import igrf
from sitl import Scenario, Twin, load, segments, simulate, simulate_like
from sitl.dataset import channels
from sitl.instrument import Instrument
from sitl.mission import Leg, Legs, Spirals
from sitl.platform import Vehicle
from sitl.scenario import SCENARIOS
from sitl.trajectory import Motion
from sitl.world import Geology

PERFECT = Instrument(noise_sigma=0.0, corner=0.0)
SHORT = (Legs(runs=(Leg(duration=400, pitch=-26, turn=0.8), Leg(duration=400, pitch=26, turn=0.8))),)


@pytest.fixture(scope="module")
def demo() -> xr.Dataset:
    return simulate(load("demo"), 3)


def test_every_scenario_that_comes_along_reads_and_another_is_named(tmp_path: Path) -> None:
    assert {path.stem for path in SCENARIOS.glob("*.toml")} >= {"bonne_bay", "demo", "comet", "seaglider"}
    for path in SCENARIOS.glob("*.toml"):
        assert load(path.stem) == load(path)
    with pytest.raises(ConfigError, match="waltz"):
        load(tmp_path / "waltz.toml")


def test_a_deployment_has_the_contracts_columns(demo: xr.Dataset) -> None:
    for name in (
        *("mag_x", "mag_y", "mag_z", "mag_time_x", "mag_time_y", "mag_time_z", "sensor_temperature"),
        *("roll", "pitch", "heading", "latitude", "longitude", "depth"),
        *("reference_field", "battpos", "ballast"),
    ):
        assert demo[name].dims == ("time",)
        assert demo[name].dtype == np.float64
        assert demo[name].attrs["units"]
        assert demo[name].attrs["long_name"]
        assert np.isfinite(demo[name]).all()
    assert np.all(np.diff(demo["time"]) > 0)
    assert 0 <= float(demo["heading"].min()) <= float(demo["heading"].max()) < 360
    assert {"calibration", "survey"} == set(segments(demo))
    assert sum(part.sizes["time"] for part in segments(demo).values()) == demo.sizes["time"]


def test_the_seed_says_it_all(demo: xr.Dataset) -> None:
    xr.testing.assert_identical(demo, simulate(load("demo"), 3))
    assert not np.array_equal(demo["mag_x"], simulate(load("demo"), 4)["mag_x"])


def test_another_instrument_does_not_change_the_world_or_the_flight(demo: xr.Dataset) -> None:
    scenario = load("demo").replace(instrument=PERFECT)
    other = simulate(scenario, 3)
    for name in ("truth_total_field", "battpos", "pitch", "truth_latitude"):
        np.testing.assert_array_equal(demo[name][: other.sizes["time"]], other[name][: demo.sizes["time"]])


def test_a_perfect_instrument_on_a_vehicle_without_iron_reads_the_truth() -> None:
    scenario = load("demo").replace(instrument=PERFECT, vehicle=Vehicle(), mission=SHORT)
    deployment = simulate(scenario, 1)
    np.testing.assert_allclose(error_of(deployment), 0.0, atol=0.5)  # attitude between points is linear
    magnitude = np.linalg.norm(channels(deployment), axis=1)
    np.testing.assert_allclose(magnitude, deployment["truth_total_field"], atol=0.02)


def test_the_same_masses_at_rest_leave_an_ellipsoid_and_moving_do_not() -> None:
    def residual(runs: tuple[Leg, ...]) -> float:
        scenario = load("demo").replace(instrument=PERFECT, mission=(Legs(runs=runs),))
        deployment = simulate(scenario, 2)
        x, y, z = channels(deployment).T / 5e4
        quadric = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z])
        f2 = (deployment["truth_total_field"].to_numpy() / 5e4) ** 2
        error = quadric @ np.linalg.lstsq(quadric, f2, rcond=None)[0] - f2
        return float(np.std(error) * 5e4 / 2)

    attitudes = [(-26, -20), (26, 20), (-10, 5), (10, -5), (-40, 0)]
    rest = [
        Leg(duration=400, pitch=p, roll=r, turn=1.8, parameters={"battpos": 0.2, "ballast": -200})
        for p, r in attitudes
    ]
    # from rest to rest the masses stand still, so even the turning points lie on the ellipsoid
    assert residual(tuple(rest)) < 0.1
    moved = [
        msgspec.structs.replace(leg, parameters={"battpos": 0.5 - 0.25 * k, "ballast": 100.0 * (k - 2)})
        for k, leg in enumerate(rest)
    ]
    assert residual(tuple(moved)) > 10


def test_the_map_reference_is_the_igrf_and_a_map_without_fine_structure() -> None:
    scenario = load("bonne_bay").replace(mission=(Spirals(duration=200.0),))
    deployment = simulate(scenario, 5)
    main = np.linalg.norm(
        igrf(*(deployment[name] for name in ("longitude", "latitude", "depth", "time"))), axis=1
    )
    anomaly = Twin.draw(scenario, 5).anomaly_map()
    there = anomaly.anomaly_at(deployment["longitude"], deployment["latitude"])
    np.testing.assert_allclose(deployment["reference_field"] - main, there, atol=1e-6)


def calibrated(folder: Path, known: Calibration, instrument: Instrument) -> Scenario:
    """Return a calm scenario whose vehicle and sensor are those of a calibration."""
    save_calibration(known, folder / "cal.json")
    (folder / "scene.toml").write_text("name = 'calibrated'\ncalibration = 'cal.json'\n")
    calm = Motion(wander=(0.0, 0.0, 0.0))
    return load(folder / "scene.toml").replace(instrument=instrument, mission=SHORT, motion=calm)


def error_of(deployment: xr.Dataset) -> np.ndarray:
    """Return the readings minus the true field (n, 3), nT."""
    truth = np.column_stack([deployment[f"truth_field_{axis}"] for axis in "xyz"])
    return np.asarray(channels(deployment) - truth)


def test_a_calibration_stands_in_for_vehicle_and_instrument(tmp_path: Path) -> None:
    plain = identity((Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0),), 53_000.0)
    hard_iron = np.array([0.0] * 6 + [100.0, -200.0, 300.0])
    scenario = calibrated(tmp_path, replace(plain, coefficients=hard_iron), PERFECT)
    error = error_of(simulate(scenario, 1))
    np.testing.assert_allclose(error, np.tile(hard_iron[6:], (len(error), 1)), atol=0.02)


@pytest.mark.parametrize("driven", [False, True], ids=["mission", "log"])
def test_an_effect_of_temperature_follows_the_fluxgates_own(driven: bool, tmp_path: Path) -> None:
    """Driven by a log, the effect followed the log's temperature, and the simulated log held another."""
    warm = ChannelEffect(cause="temperature_offset", channel="sensor_temperature")
    coefficients = np.append(np.zeros(9), (20.0, 0.0, -10.0))
    extended = replace(
        identity((), 53_000.0), effects=(warm,), coefficients=coefficients, covariance=np.eye(12)
    )
    cooling = msgspec.structs.replace(PERFECT, start_temperature=-10.0, thermal_lag=300.0)
    scenario = calibrated(tmp_path, extended, cooling)
    if driven:
        log = simulate(load("demo").replace(mission=SHORT), 1)
        log = log.assign(sensor_temperature=log["sensor_temperature"] + 7.0)
        deployment = simulate_like(log, scenario, 1)
    else:
        deployment = simulate(scenario, 1)
    temperature = deployment["sensor_temperature"].to_numpy()
    assert np.ptp(temperature) > 5.0
    np.testing.assert_allclose(error_of(deployment), temperature[:, None] * (20.0, 0.0, -10.0), atol=0.1)


def test_an_unknown_current_moves_the_truth_from_where_the_vehicle_believes_to_be() -> None:
    deployment = simulate(load("demo").replace(telemetry={"drift": 0.1}, mission=SHORT), 1)
    off = deployment["truth_latitude"] - deployment["latitude"]
    assert abs(float(off[0])) < 1e-9
    np.testing.assert_allclose(off / off[-1], np.linspace(0, 1, len(off)), atol=1e-6)


def test_a_scenario_without_a_mission_wants_a_log() -> None:
    with pytest.raises(WrongUse, match="no mission"):
        simulate(Scenario(name="empty"))


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("colour = 'red'", "colour: unknown key"),
        ("[world]\nlatitude = 91.0", "world.latitude: expected"),
        ("[world.geology]\nrms = 'rough'", "world.geology.rms: expected"),
        ("masses = ['keel']", "masses: expected one of"),
        ("start = 2013-12-11T12:00:00", "start: expected"),
        ("[vehicle.mass.keel]\nat = [0.0, 0.0]", "vehicle.mass.keel.at: expected"),
        ("[limits.battpos]\nlow = 0.0", "limits.battpos.high: missing"),
        ("[[mission]]\nkind = 'waltz'", "mission[0].kind"),
        ("[[mission]]\nkind = 'spirals'\ntrial = 3", "mission[0].trial"),
        ("calibration = 'nowhere.json'", "calibration: no such file"),
        ("start =", "not TOML"),
    ],
)
def test_a_mistake_in_a_scenario_is_one_line_that_names_the_key(
    tmp_path: Path, line: str, complaint: str
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(f"name = 'bad'\n{line}\n")
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert complaint in message
    assert "\n" not in message


def test_a_log_drives_the_model_to_what_made_the_log() -> None:
    """A simulated deployment's own telemetry, without its noise, gives the deployment again."""
    quiet, bare = {"roll_pitch_sigma": 0.0, "heading_sigma": 0.0}, {"geology": Geology(sources=0)}
    scenario = load("demo").replace(telemetry=quiet, world=bare, instrument=PERFECT, mission=SHORT)
    scenario = scenario.replace(vehicle=Twin.draw(load("demo"), 9).vehicle)
    deployment = simulate(scenario, 9)
    again = simulate_like(deployment, scenario, 9)
    np.testing.assert_allclose(channels(again), channels(deployment), atol=0.1)
    np.testing.assert_array_equal(again["pitch"], deployment["pitch"])


def test_gaps_in_the_telemetry_are_bridged(demo: xr.Dataset) -> None:
    scenario = load("comet")
    log = demo.isel(time=slice(0, 400)).copy(deep=True)
    whole = simulate_like(log, scenario, 1)
    log["pitch"][100:110] = np.nan
    log["battpos"][:5] = np.nan
    bridged = simulate_like(log, scenario, 1)
    assert np.isfinite(channels(bridged)).all()
    assert np.isnan(bridged["pitch"][100:110]).all()
    np.testing.assert_allclose(channels(bridged)[150:], channels(whole)[150:], atol=1e-6)


def test_a_log_without_what_the_model_needs_is_refused(demo: xr.Dataset) -> None:
    log = demo.isel(time=slice(0, 50))
    with pytest.raises(FormatError, match="battpos"):
        simulate_like(log.drop_vars("battpos"), load("comet"))
    with pytest.raises(FormatError, match="'roll'"):
        simulate_like(log.assign(roll=log["roll"] * np.nan), load("comet"))
    with pytest.raises(FormatError, match="two rows"):
        simulate_like(log.isel(time=slice(0, 1)), load("comet"))


@pytest.mark.real
def test_a_seagliders_own_attitude_explains_its_magnetometer(real_data: Path) -> None:
    """The model's true field in body axes, with real telemetry, is what the real sensor read.

    Its counts are of 100 nT.
    """
    log = logs.read(sorted((real_data / "seaglider_sg167").glob("*.nc")))
    simulated = simulate_like(log, load("seaglider"), 1)
    measured = np.column_stack([channels(log), np.ones(log.sizes["time"])])
    truth = np.column_stack([simulated[f"truth_field_{axis}"] for axis in "xyz"])
    known = np.isfinite(measured).all(axis=1)
    matrix, *_ = np.linalg.lstsq(measured[known], truth[known], rcond=None)
    assert np.std(measured[known] @ matrix - truth[known]) < 400
    np.testing.assert_allclose(matrix[:3], np.eye(3), atol=0.06)
    assert np.isfinite(simulated["reference_field"]).all()


@pytest.mark.real
def test_a_slocums_telemetry_drives_a_glider_that_it_never_was(real_data: Path) -> None:
    pytest.importorskip("dbdreader")
    log = logs.read(sorted((real_data / "slocum_comet").glob("*.[de]bd")))
    simulated = simulate_like(log, load("comet"), 1)
    np.testing.assert_array_equal(simulated["battpos"], log["battpos"])
    for name in ("mag_x", "mag_y", "mag_z", "truth_total_field", "reference_field"):
        assert np.isfinite(simulated[name]).all()
    raw = np.linalg.norm(channels(simulated), axis=1)
    assert 100 < np.std(raw - simulated["truth_total_field"]) < 5000  # its iron, turned by its attitudes
