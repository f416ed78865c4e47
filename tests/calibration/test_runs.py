"""Dipoles as polynomials, boresight, what runs can tell, and which to fly next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.dipole import Dipole, dipole_tensor
from magbridge.calibration.fitting.boresight import field_body, find_boresight
from magbridge.calibration.fitting.columns import observations
from magbridge.calibration.fitting.data import Observations, polynomial_samples
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.geometry import read_vehicle
from magbridge.calibration.fitting.identify import combinations
from magbridge.calibration.fitting.mission import Mission, expected_error
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference, identity
from magbridge.calibration.planning.limits import Limits, PlannedRun, settled, trim_of
from magbridge.calibration.planning.plan import evaluate_runs, expected_calibration, plan
from magbridge.calibration.terms import Effect, full_order
from magbridge.errors import CalibrationError, ConfigError, FormatError
from sitl.mission import TABLE_1

Gliders = Callable[..., Any]


def test_a_dipole_term_is_the_dipole() -> None:
    """Hard iron along the travel is G(r) m to a millionth, and the induced part turns with the field."""
    at, travel, moment = (
        np.array([-0.4, 0.05, 0.1]),
        np.array([0.03, 0.0, 0.01]),
        np.array([900.0, -300.0, 50.0]),
    )
    cal = Calibration(
        parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),),
        terms=(Dipole(parameter="p", at=tuple(at), travel=tuple(travel)),),
        coefficients=np.concatenate([moment, [30.0, 20.0, 10.0], np.zeros(3)]),
        covariance=np.zeros((9, 9)),
        noise=Noise(0.0),
        reference=Reference(5e4),
    )
    p = np.linspace(-1, 1, 9)[:, None]
    A, T = cal.matrices(p)
    G = dipole_tensor(at + p * travel) * np.linalg.norm(at) ** 3
    np.testing.assert_allclose(T, G @ moment, atol=2e-3)
    pulled = G * np.array([30.0, 20.0, 10.0]) / 5e4
    np.testing.assert_allclose(A, np.eye(3) - (pulled + np.swapaxes(pulled, 1, 2)) / 2, atol=1e-8)


def test_a_dipole_that_passes_the_sensor_is_refused() -> None:
    with pytest.raises(CalibrationError, match="within three half-travels"):
        Calibration(
            parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),),
            terms=(Dipole(parameter="p", at=(0.1, 0.0, 0.0), travel=(0.05, 0.0, 0.0)),),
            coefficients=np.zeros(9),
            covariance=np.zeros((9, 9)),
            noise=Noise(0.0),
            reference=Reference(5e4),
        ).matrices(np.zeros((1, 1)))


def test_boresight_is_found_and_makes_the_vector_right(glider: Gliders) -> None:
    rng = np.random.default_rng(0)
    n = 400
    attitude = np.column_stack([rng.normal(0, 0.1, n), rng.normal(0, 0.4, n), rng.uniform(0, 2 * np.pi, n)])
    ned = np.tile([16e3, -5e3, 49e3], (n, 1))
    tilt = Rotation.from_rotvec([0.02, -0.03, 0.05])
    body = field_body(attitude, ned)
    data = Observations(
        tilt.inv().apply(body) + rng.normal(0, 1, (n, 3)), np.linalg.norm(ned, axis=1), np.empty((n, 0)),
        runs=np.arange(n) // 100, attitude=attitude, reference_ned=ned,
    )  # fmt: skip
    found = find_boresight(identity(), data)
    np.testing.assert_allclose(found.rotation, tilt.as_rotvec(), atol=1e-4)
    np.testing.assert_allclose(found.matrix(), Rotation.from_rotvec(found.rotation).as_matrix(), atol=1e-12)
    vector = correct(replace(identity(), boresight=found), data.field, data.parameters, data.time).vector
    np.testing.assert_allclose(vector, body, atol=12.0)
    assert find_boresight(identity(), replace(data, attitude=None)) is None


def test_table_1_sees_63_of_90_coefficients(glider: Gliders) -> None:
    """Ballast at two positions: squares and cubes of it cannot be told apart."""
    runs = glider(0, 2).runs
    held = np.array([np.median(runs.parameters[runs.runs == r], axis=0) for r in runs.runs])
    samples = polynomial_samples(replace(runs, parameters=held), full_order(2, 3))
    seen = combinations(samples, np.zeros(90), 1.0)
    assert seen.rank == 63
    assert (np.diff(seen.sigma) >= 0.0).all()


def test_readings_that_a_fit_multiplies_are_told(glider: Gliders) -> None:
    """Anomalies shrink with the readings: a reference that is wrong along the track can do that unnoticed."""
    runs = glider(0, 2).runs
    told = [fit(replace(runs, field=gain * runs.field), "nominal").warnings for gain in (1.0, 1.3, 0.8)]
    plain, shrunk, grown = (" ".join(one).partition("the fit multiplies the readings by ")[2] for one in told)
    assert not plain
    assert float(shrunk[:4]) < 0.8
    assert float(grown[:4]) > 1.1


def test_warnings_are_in_a_pilot_s_words(glider: Gliders) -> None:
    words = "\n".join(fit(glider(0, 2).runs).warnings)
    assert "ballast was only ever at 2 positions (-200 and 200 cm3)" in words
    assert "battpos and ballast always moved together" in words
    assert "roll stayed within" in words
    assert "the vertical offset is known only to" in words
    dives = glider(0, 2).runs.part(np.degrees(glider(0, 2).runs.attitude[:, 1]) < 0.0)
    words = "\n".join(
        fit(replace(dives, parameters=dives.parameters[:, :1], names=("battpos",), units=("in",))).warnings
    )
    assert "only dives" in words


def test_a_fit_from_a_corner_of_the_compass_is_not_supported(glider: Gliders) -> None:
    """Any iron fits samples that all head one way: a real ArduSub was 300 nT off there, 1,700 beyond."""
    runs = glider(0, 2).runs
    turned = np.degrees(runs.attitude[:, 2]) % 360.0
    found = fit(runs.part((turned > 200.0) & (turned < 260.0)), "nominal")
    assert not found.supported
    assert any("all headings lie within 60 degrees" in warning for warning in found.warnings)
    assert fit(runs, "nominal").supported


def test_a_fit_that_the_data_cannot_hold_says_so(glider: Gliders) -> None:
    runs = glider(0, 2).runs
    few = runs.part((np.asarray(runs.runs) < 2) & (np.cos(runs.attitude[:, 2]) > 0.5))
    found = fit(few, "cubic")
    assert not found.supported
    assert "do not support" in found.warnings[0]
    assert fit(runs).supported


def test_expected_error_is_what_comes(glider: Gliders) -> None:
    one = glider(1, 2)
    calibration = fit(one.runs).calibration
    expected = expected_error(calibration, Mission.of(one.survey))
    total = correct(calibration, one.quiet, one.survey.parameters, one.survey.time).total
    assert np.sqrt(np.mean((total - one.survey.reference) ** 2)) < 3.0 * np.sqrt(np.mean(expected**2))


def test_planned_runs_beat_table_1(glider: Gliders) -> None:
    """Six against ten, trimmed as the glider trims itself, banked no more than the paper's spirals."""
    one = glider(2, 2)
    parameters = one.runs.ranges()
    before = expected_calibration(parameters, 52_000.0)
    mission = Mission.of(one.survey)
    ned = one.runs.reference_ned[0]
    paper = evaluate_runs(
        before, mission, ned,
        [PlannedRun(pitch, 6.0, (battery, float(np.copysign(200.0, pitch))))
         for _, pitch, battery, _ in TABLE_1],
    )  # fmt: skip
    limits = Limits(roll=(-6.0, 6.0), pitch_at=trim_of(one.runs), flown=settled(one.runs))
    ours = plan(before, mission, ned, limits, runs=6)
    assert len(ours.runs) == 6
    assert ours.worst[-1] < 0.5 * paper.worst[-1]
    assert ours.rms[-1] < 0.5 * paper.rms[-1]
    assert all(run.pitch * run.parameters[1] > 0.0 for run in ours.runs), (
        "dives with the ballast in, climbs out"
    )
    assert all(-6.0 <= run.roll <= 6.0 and 14.0 <= abs(run.pitch) <= 30.0 for run in ours.runs)
    with pytest.raises(CalibrationError, match="within the vehicle's limits"):
        plan(before, mission, ned, replace(limits, pitch=(80.0, 85.0)), runs=1)


def test_vehicle_toml(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text("[mass.battpos]\nat = [-0.45, 0.0, 0.05]\nat_sigma = 0.05\ntravel = [0.0254, 0.0, 0.0]\n")
    assert read_vehicle(path)["battpos"].at == (-0.45, 0.0, 0.05)
    for text, match in (
        ("[mass.battpos]\nat = [1, 2]\ntravel = [0, 0, 0]", "mass.*at"),
        ("[mass.battpos]\nat = [1.0, 0.0, 0.0]\ntravel = [0.0, 0.0, 0.0]\nweight = 3", "weight"),
        ("[mass", "not TOML"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=match):
            read_vehicle(path)


def test_a_mass_that_no_parameter_moves_is_refused(glider: Gliders) -> None:
    vehicle = {"fin": {"at": [1.0, 0.0, 0.0], "travel": [0.0, 0.0, 0.1]}}
    with pytest.raises(CalibrationError, match="mass 'fin'"):
        fit(glider(0, 2).runs, vehicle=vehicle)


def test_a_deployment_s_columns_become_observations() -> None:
    xr = pytest.importorskip("xarray")
    n = 50
    rng = np.random.default_rng(0)
    columns = {f"mag_{axis}": ("time", rng.normal(0, 3e4, n)) for axis in "xyz"}
    columns |= {
        "battpos": ("time", rng.normal(0, 1, n), {"units": "in"}),
        "reference_field": ("time", np.full(n, 5e4)),
    }
    ds = xr.Dataset(columns, coords={"time": np.arange(n) * 4.0})
    data = observations(ds, ["battpos"])
    assert data.names == ("battpos",)
    assert data.units == ("in",)
    assert len(data) == n
    with pytest.raises(FormatError, match=r"column 'fin': expected .*; there are: .* battpos"):
        observations(ds, ["fin"])
    with pytest.raises(CalibrationError, match="'battpos': expected numbers"):
        observations(ds.assign(battpos=("time", np.array(["a"] * n))), ["battpos"])


def test_a_term_that_lacks_a_method_cannot_be_made() -> None:
    class Half(Effect, frozen=True, kw_only=True):
        kind = "half"

    with pytest.raises(TypeError, match=r"abstract methods? .*begin"):
        Half()  # type: ignore[abstract]
