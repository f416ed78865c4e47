"""Test the heading with its standard deviation, and the boresight from roll and pitch only."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from demos import demo_log
from gliders import codes
from scipy.spatial.transform import Rotation

import magbridge as mb
from magbridge.arrays import FloatArray
from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.boresight import (
    boresight_from_tilt,
    field_body,
    find_boresight,
    magnetic_headings,
)
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit
from magbridge.calibration.fitting.uncertainty import expected_heading_sigma
from magbridge.calibration.heading import (
    heading,
    heading_of_sample,
    model_declination_sigma,
    published_covariance,
)
from magbridge.calibration.model import Boresight, identity
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from sitl import load

NED = np.array([16e3, -5e3, 49e3])
TOTAL = float(np.linalg.norm(NED))
INCLINATION = float(np.arcsin(NED[2] / TOTAL))
DECLINATION_DEG = float(np.degrees(np.arctan2(NED[1], NED[0])))


def body_field(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return the field in body axes, (n, 3), from angles in rad, by a naive implementation."""
    attitude = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    return np.asarray(attitude.inv().apply(np.tile(NED, (len(roll), 1))))


def observed(field: FloatArray, attitude: FloatArray, ned: FloatArray = NED, **more: Any) -> Observations:
    """Return readings (n, 3) at attitudes (n, 3), rad, in a uniform field."""
    reference = np.full(len(field), np.linalg.norm(ned))
    return Observations(
        field, reference, np.empty((len(field), 0)), attitude=attitude,
        reference_ned=np.tile(ned, (len(field), 1)), **more,
    )  # fmt: skip


def difference_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((a - b + 180.0) % 360.0 - 180.0)


def attitudes(n: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, n), rng.uniform(-1.2, 1.2, n), rng.uniform(0.0, 2.0 * np.pi, n)


def test_the_heading_of_an_exact_vector_is_the_vehicles() -> None:
    roll, pitch, yaw = attitudes(200)
    found = heading(body_field(roll, pitch, yaw), roll, pitch, DECLINATION_DEG)
    np.testing.assert_allclose(difference_deg(found.true, np.degrees(yaw)), 0.0, atol=1e-9)
    np.testing.assert_allclose(difference_deg(found.true, found.magnetic), DECLINATION_DEG, atol=1e-9)


@pytest.mark.parametrize("source", ["vector", "boresight", "tilt", "declination"])
def test_sigma_is_the_scatter_that_each_error_causes(source: str) -> None:
    n, rng = 40_000, np.random.default_rng(3)
    roll, pitch, yaw = (np.full(n, angle) for angle in (0.2, -0.45, 2.1))
    vector = body_field(roll, pitch, yaw)
    root = rng.normal(0.0, 60.0, (3, 3))
    covariance, turn, tilt_deg, declination_deg = np.zeros((3, 3)), np.zeros((3, 3)), 0.0, 0.0
    declination = np.full(n, DECLINATION_DEG)
    if source == "vector":
        covariance = root @ root.T
        vector += rng.normal(size=(n, 3)) @ root.T
    elif source == "boresight":
        turn = root @ root.T * 1e-8
        vector = Rotation.from_rotvec(rng.normal(size=(n, 3)) @ root.T * 1e-4).apply(vector)
    elif source == "tilt":
        tilt_deg = 0.4
        roll, pitch = roll + np.radians(rng.normal(0, 0.4, n)), pitch + np.radians(rng.normal(0, 0.4, n))
    else:
        declination_deg = 0.7
        declination += rng.normal(0.0, 0.7, n)
    found = heading(
        vector, roll, pitch, declination, covariance=np.tile(covariance, (n, 1, 1)),
        boresight_covariance=turn, tilt_sigma_deg=tilt_deg, declination_sigma_deg=declination_deg,
    )  # fmt: skip
    scatter = np.std(difference_deg(found.true, np.degrees(yaw)))
    assert scatter == pytest.approx(float(np.median(found.sigma)), rel=0.03)


def test_where_there_is_no_horizontal_field_the_heading_is_unknown() -> None:
    vector = np.array([[0.5, 0.5, 50_000.0], [np.nan, 1.0, 2.0]])
    found = heading(vector, np.zeros(2), np.zeros(2), covariance=np.tile(25.0 * np.eye(3), (2, 1, 1)))
    assert found.sigma[0] == pytest.approx(180.0 / np.sqrt(3.0))
    assert np.isnan(found.magnetic[1])
    assert np.isinf(found.sigma[1])


@pytest.mark.parametrize("added", [0.0, 30.0])
def test_variance_beyond_the_calibration_s_is_shared_by_the_axes(added: float) -> None:
    """The boresight's part of the published variance comes from naive cross products."""
    rng = np.random.default_rng(4)
    root, turn = rng.normal(0.0, 3.0, (3, 3)), np.diag([1e-5, 2e-5, 4e-5])
    stated, vector = root @ root.T, np.array([20_000.0, -9_000.0, 45_000.0])
    cross = np.cross(np.eye(3), vector)
    published = np.trace(stated) + np.trace(cross @ turn @ cross.T) + 3.0 * added
    (found,) = published_covariance(stated[None], turn, vector[None], np.array([published]))
    np.testing.assert_allclose(found, stated + added * np.eye(3), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_one_sample_gives_the_heading_of_the_array_path(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 200
    vector = rng.normal(0.0, 30_000.0, (n, 3))
    vector[:3] = [[0.0, 0.0, 40_000.0], [np.nan, 1.0, 1.0], [1e-3, 0.0, 50_000.0]]
    roll, pitch = rng.normal(0.0, 0.5, n), rng.uniform(-1.4, 1.4, n)
    roll[0] = pitch[0] = 0.0
    root = rng.normal(0.0, 3.0, (n, 3, 3))
    stated = root @ root.transpose(0, 2, 1)
    turn = np.diag(rng.uniform(1e-6, 1e-4, 3))
    published = np.where(rng.random(n) < 0.1, np.inf, rng.uniform(0.0, 500.0, n))
    declination, declination_sigma = rng.uniform(-30.0, 30.0, n), rng.uniform(0.2, 3.0, n)
    declination[5] = declination_sigma[5] = np.nan
    many = heading(
        vector, roll, pitch, declination, covariance=published_covariance(stated, turn, vector, published),
        boresight_covariance=turn, tilt_sigma_deg=0.4, declination_sigma_deg=declination_sigma,
    )  # fmt: skip
    one = np.array([
        heading_of_sample(
            tuple(vector[k].tolist()), float(roll[k]), float(pitch[k]), float(declination[k]),
            stated[k].ravel().tolist(), turn.ravel().tolist(), float(published[k]),
            tilt_sigma_deg=0.4, declination_sigma_deg=float(declination_sigma[k]),
        )
        for k in range(n)
    ])  # fmt: skip
    np.testing.assert_allclose(
        one, np.stack([many.magnetic, many.true, many.sigma], axis=1), rtol=1e-9, atol=1e-9
    )


def test_the_declinations_sigma_grows_towards_the_pole_and_with_the_crust() -> None:
    at_20_000, at_2_000 = model_declination_sigma(np.array([20_000.0, 2_000.0]))
    assert at_20_000 == pytest.approx(np.hypot(0.26, 5417.0 / 20_000.0))
    assert at_2_000 > 2.7
    crustal = model_declination_sigma(np.array([20_000.0]), 300.0)[0]
    assert crustal == pytest.approx(np.hypot(at_20_000, np.degrees(300.0 / np.sqrt(2.0) / 20_000.0)))


def simulate_runs(
    seed: int, pitch_deg: float, scatter: float = 0.02, runs: int = 10, offset_deg: float = 0.2
) -> tuple[Boresight, Rotation]:
    """Return the boresight of ten runs, alternately down and up, and the true rotation; `scatter` in rad."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(runs), 200)
    n = len(run)
    pitch = np.where(run % 2 == 0, -1.0, 1.0) * np.radians(pitch_deg) + scatter * rng.normal(size=n)
    roll, yaw = 2.5 * scatter * rng.normal(size=n), rng.uniform(0.0, 2.0 * np.pi, n)
    true = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3))
    vector = true.inv().apply(body_field(roll, pitch, yaw)) + rng.normal(0.0, 1.0, (n, 3))
    offset = np.radians(offset_deg) * rng.normal(size=(runs, 2))
    noise = np.radians(0.1) * rng.normal(size=(n, 2))
    measured = np.column_stack([roll, pitch]) + offset[run] + noise
    found = boresight_from_tilt(
        vector, measured[:, 0], measured[:, 1], np.full(n, TOTAL), np.full(n, INCLINATION), run
    )
    return found, true


def test_a_boresight_needs_no_heading_and_its_covariance_holds() -> None:
    squares = []
    for seed in range(24):
        found, true = simulate_runs(seed, 24.0)
        error = (true * Rotation.from_rotvec(found.rotation).inv()).as_rotvec()
        squares.append(error @ np.linalg.solve(found.covariance, error) / 3.0)
        assert np.degrees(np.linalg.norm(error)) < 0.8
    assert 0.6 < np.mean(squares) < 1.5  # chi squared of 72: 0.7 to 1.35 in 95 %


@pytest.mark.parametrize("offset_deg", [0.0, 0.2])
def test_the_tilt_s_sigma_is_that_of_its_noise_and_of_the_runs_offsets(offset_deg: float) -> None:
    found = [simulate_runs(seed, 24.0, runs=20, offset_deg=offset_deg)[0].tilt_sigma for seed in range(8)]
    assert np.mean(found) == pytest.approx(np.hypot(0.1, offset_deg), rel=0.25)


def test_a_vehicle_that_stays_level_leaves_the_heading_of_the_mounting_open() -> None:
    level, diving = (
        np.sqrt(np.diag(simulate_runs(1, pitch, scatter=scatter)[0].covariance))
        for pitch, scatter in ((0.0, 0.0), (24.0, 0.02))
    )
    assert np.argmax(level) == 2
    assert level[2] > 30.0 * diving.max()


def test_a_sensor_mounted_upside_down_is_found() -> None:
    rng = np.random.default_rng(5)
    roll, yaw = rng.normal(0.0, 0.1, 600), rng.uniform(0.0, 2.0 * np.pi, 600)
    pitch = rng.choice([-0.4, 0.4], 600)
    true = Rotation.from_euler("x", 180.0, degrees=True) * Rotation.from_rotvec([0.02, 0.01, 0.3])
    found = boresight_from_tilt(
        true.inv().apply(body_field(roll, pitch, yaw)), roll, pitch, np.full(600, TOTAL),
        np.full(600, INCLINATION), np.arange(600) // 100,
    )  # fmt: skip
    assert np.degrees((true * Rotation.from_rotvec(found.rotation).inv()).magnitude()) < 0.02


def test_correct_writes_the_heading_of_a_log_and_states_its_error() -> None:
    """The log's own headings are not used: they may come from the very compass that is calibrated."""
    log = demo_log()
    true = log["heading"].to_numpy()
    without = log.drop_vars("heading")
    runs = mb.observations(without.isel(time=slice(0, 2250)), ("battpos", "ballast"))
    found = mb.fit(runs)
    assert found.calibration.boresight is not None
    corrected = mb.correct_rows(mb.Correction(found.calibration), without)
    good = corrected["quality"].to_numpy() == 0
    error = difference_deg(corrected["heading"].to_numpy(), true)[good]
    sigma = corrected["heading_sigma"].to_numpy()[good]
    assert np.sqrt(np.mean(error**2)) < 1.5
    of_both = np.hypot(sigma, load("demo").telemetry.heading_sigma)
    assert 0.75 < np.sqrt(np.mean((error / of_both) ** 2)) < 1.25
    expected = expected_heading_sigma(found.calibration, runs)  # without the declination's part
    assert 0.5 * np.median(sigma) < expected < 1.5 * np.median(sigma)
    shift = difference_deg(corrected["heading"].to_numpy(), corrected["magnetic_heading"].to_numpy())
    np.testing.assert_allclose(shift[good], corrected["declination"].to_numpy()[good], atol=1e-9)


# ---- the rotation from sensor to body axes -----------------------------------------------------------------


def test_boresight_is_found_and_makes_the_vector_right() -> None:
    rng = np.random.default_rng(0)
    n = 400
    attitude = np.column_stack([rng.normal(0, 0.1, n), rng.normal(0, 0.4, n), rng.uniform(0, 2 * np.pi, n)])
    tilt = Rotation.from_rotvec([0.02, -0.03, 0.05])
    body = body_field(*attitude.T)
    data = observed(tilt.inv().apply(body) + rng.normal(0, 1, (n, 3)), attitude, runs=np.arange(n) // 100)
    found = find_boresight(identity(), data)
    np.testing.assert_allclose(found.rotation, tilt.as_rotvec(), atol=1e-4)
    vector = correct(replace(identity(), boresight=found), data.field, data.parameters, data.time).vector
    np.testing.assert_allclose(vector, body, atol=12.0)
    assert find_boresight(identity(), replace(data, attitude=None)) is None


@pytest.mark.parametrize(("pitch", "turn"), [(0.0, 17.4), (24.0, 7.4)])
def test_magnetic_headings_that_are_taken_for_true_are_reported(pitch: float, turn: float) -> None:
    """A level vehicle's mounting looks turned by the declination; a glider's by less than half of it."""
    rng = np.random.default_rng(2)
    n = 2000
    north, east, _ = ned = np.array([16e3, -5e3, 46e3])
    attitude = np.radians(
        np.column_stack([rng.normal(0, 1, n), rng.choice([-pitch, pitch], n), rng.uniform(0, 360, n)])
    )
    field = field_body(attitude, np.tile(ned, (n, 1))) + rng.normal(0, 1, (n, 3))
    right = observed(field, attitude, ned, runs=np.arange(n) // 100)
    read = attitude - [0.0, 0.0, np.arctan2(east, north)]
    assert magnetic_headings(identity(), right) is None
    warning = magnetic_headings(identity(), replace(right, attitude=read))
    assert warning is not None
    assert warning.values["declination"] == pytest.approx(-17.4, abs=0.05)
    found = np.degrees(np.linalg.norm(find_boresight(identity(), replace(right, attitude=read)).rotation))
    assert found == pytest.approx(turn, abs=0.7)
    assert "magnetic_headings" in codes(fit(replace(right, attitude=read), "nominal"))
    assert "magnetic_headings" not in codes(fit(right, "nominal"))
    # a mounting that is turned by about as much as D, of a glider, leaves no mismatch, and no message
    turned = replace(right, field=Rotation.from_euler("z", 10.0, degrees=True).apply(field))
    assert magnetic_headings(identity(), turned) is None


def test_headings_of_another_instrument_determine_what_the_magnitude_leaves_open() -> None:
    """Small angles of roll and pitch: the magnitude hardly shows the vertical offset, the vector does."""
    rng, n = np.random.default_rng(4), 1200
    roll, pitch = rng.normal(0.0, 0.06, n), rng.normal(0.0, 0.04, n)
    yaw = np.linspace(0.0, 8 * np.pi, n)
    body, mounted = body_field(roll, pitch, yaw), Rotation.from_rotvec([0.02, -0.03, 0.4])
    offset = np.array([400.0, -250.0, 900.0])
    field = mounted.inv().apply(body) @ np.linalg.inv(np.diag([1.01, 0.985, 1.004])).T + offset
    data = observed(field + rng.normal(0.0, 20.0, (n, 3)), np.column_stack([roll, pitch, yaw]))

    def vector_error(found: Fit) -> float:
        vector = correct(found.calibration, field, data.parameters, data.time).vector
        return rms(np.linalg.norm(vector - body, axis=1))

    magnitude, levelled = fit(data, "nominal"), fit(data, "horizontal")
    with_headings = fit(replace(data, independent_headings=True), "nominal")
    assert vector_error(with_headings) < 0.4 * vector_error(magnitude)
    assert vector_error(levelled) < 0.85 * vector_error(magnitude)
    assert levelled.calibration.method == "horizontal"
    known = with_headings.calibration
    assert np.abs((known.coefficients[6:] - offset) / np.sqrt(np.diag(known.covariance))[6:]).max() < 3.5
    with pytest.raises(CalibrationError, match="direction: needs roll, pitch and heading"):
        fit(replace(data, independent_headings=True, attitude=None))


def test_a_reversed_channel_gets_no_boresight_and_is_reported() -> None:
    rng = np.random.default_rng(1)
    n = 400
    attitude = np.column_stack([rng.normal(0, 0.1, n), rng.normal(0, 0.4, n), rng.uniform(0, 2 * np.pi, n)])
    field = body_field(*attitude.T) * [1.0, 1.0, -1.0] + rng.normal(0, 1, (n, 3))
    found = fit(observed(field, attitude), "nominal")
    assert found.calibration.boresight is None
    assert "no_boresight" in codes(found)
    assert found.supported  # the total field does not depend on it
