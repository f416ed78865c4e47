"""Test that wrong samples are distinguished from a passing source, and good neighbours are kept."""

from dataclasses import replace

import numpy as np
import pytest
from demos import demo
from posed import missed
from reported import section
from scipy.signal import lfilter

from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.noise import fit_noise
from magbridge.diagnose.packets import passage
from magbridge.diagnose.problem import Problem
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.search import Outliers, outliers
from magbridge.diagnose.survey import MAX_LAG, Past

N = 5000
SPIKE = np.array([0.0, 12.0, 0.0])
PULSE = np.array([6.0, 12.0, 6.0])
"""Signature of a source that passes within a few samples, in units of the innovations."""


def found(shape: np.ndarray, rows: np.ndarray, rho: float, seed: int, nu: float = 50.0) -> Outliers | None:
    rng = np.random.default_rng(seed)
    residual = lfilter([1.0], [1.0, -rho], rng.standard_t(nu, N))
    for row in rows:
        residual[row - 1 : row + 2] += shape * rng.choice([-1.0, 1.0])
    return judged(residual, 2)


def judged(residual: np.ndarray, order: int) -> Outliers | None:
    steps = np.ones(N, int)
    steps[[0, N // 3]] = MAX_LAG
    noise = fit_noise(residual, Past(steps, order))
    none = np.zeros(0)
    return outliers(Joint(noise.log_likelihood, none, none, np.zeros((0, 0)), noise, residual, none), 18)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_isolated_samples_are_distinguished_from_a_passage(rho: float) -> None:
    """This holds even if the noise's correlation spreads a wrong sample over later innovations."""
    rows = np.arange(400, N, 700)
    for seed in range(5):
        isolated, passing = (found(shape, rows, rho, seed) for shape in (SPIKE, PULSE))
        assert isolated is not None
        assert passing is not None
        assert isolated.isolated
        assert set(rows) <= set(isolated.rows)
        assert not passing.isolated


@pytest.mark.parametrize("nu", [3.0, 50.0])
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_good_neighbours_are_rarely_questioned(nu: float, rho: float) -> None:
    """Nor those of the noise's own large innovations, which its correlation carries on."""
    rows = np.arange(300, N, 500)
    reported = [one.neighbours for seed in range(15) if (one := found(3.0 * SPIKE, rows, rho, seed, nu))]
    assert len(reported) == 15
    assert 0.3 < np.mean(reported) < 0.75
    assert np.mean(np.array(reported) < 0.1) < 0.25


@pytest.mark.parametrize("order", [2, 13])
@pytest.mark.parametrize("rho", [0.0, 0.95])
def test_a_switching_source_is_not_a_wrong_sample(rho: float, order: int) -> None:
    """Noise of a long memory absorbs a relay except its switching, which was reported as outliers."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        noise = lfilter([1.0], [1.0, -rho], rng.standard_t(50.0, N))
        relay = np.searchsorted(np.sort(rng.integers(0, N, 14)), np.arange(N)) % 2
        wrong = np.isin(np.arange(N), np.arange(400, N, 700))
        switches, spikes = (judged(noise + x, order) for x in (8.0 * relay, 12.0 * wrong))
        assert switches is not None
        assert spikes is not None
        assert (switches.lasting, switches.isolated) == (True, False)
        assert (spikes.lasting, spikes.isolated) == (False, True)


def test_next_to_a_gap_a_sample_has_no_neighbour() -> None:
    alone = found(3.0 * SPIKE, np.array([N // 3 + 1]), 0.0, 3)
    assert alone is not None
    assert alone.neighbours == 1.0


@pytest.mark.parametrize(("shape", "isolated"), [(SPIKE, True), (PULSE, False)])
def test_a_diagnosis_names_isolated_samples_only(shape: np.ndarray, isolated: bool) -> None:
    """If other samples are wrong too, the diagnosis reports a passing source."""
    calibration, survey = demo().calibration, demo().survey.copy()
    off = np.zeros(survey.sizes["time"])
    for row in (200, 900):
        off[row - 1 : row + 2] = 3.0 * shape
    for name in ("mag_x", "mag_y", "mag_z"):
        survey[name] = survey[name] * (1.0 + off / survey["reference_field"].to_numpy())
    reported = diagnose([survey], calibration).diagnosis
    assert not reported.findings
    assert (reported.wrong is not None) is isolated
    assert (reported.unexplained is None) is isolated
    assert isolated or reported.unexplained.kind == "transient"


@pytest.mark.parametrize("beside_runs", [False, True])
def test_a_relay_gets_no_name(beside_runs: bool) -> None:
    """Nor does the remainder where noise of a long memory has absorbed the rest."""
    calibration, survey = demo().calibration, demo().survey.copy()
    n, rng = survey.sizes["time"], np.random.default_rng(5 if beside_runs else 4)
    at = np.sort(rng.integers(0, n, 14))
    relay = np.searchsorted(at, np.arange(n)) % 2
    for name, size in (("mag_x", 9.0), ("mag_y", -6.0), ("mag_z", 12.0)):
        survey[name] = survey[name] + size * relay
    reported = diagnose([survey], calibration, training_logs=[demo().runs] if beside_runs else ()).diagnosis
    assert (reported.findings, reported.wrong) == ((), None)
    assert reported.unexplained is not None
    assert reported.unexplained.kind == "switching"
    found = reported.problem.survey.time[list(reported.unexplained.shifts)]
    true = survey["time"].to_numpy().astype(float)[at]
    assert sum(np.abs(found - one).min() < 40.0 for one in true) >= 10
    assert f"The level shifts at {found.size} places, " in section(reported, "What is left")


# ---- a source that passes is described by few numbers ------------------------------------------------------


def test_a_dipole_that_passes_is_reported_by_three_numbers(problem: Problem) -> None:
    """Compare Anderson's functions with a dipole's field on a straight course, along the Earth's field."""
    t = problem.survey.time - problem.survey.time[0]
    speed, nearest = 900.0 / (0.02 * t[-1]), 0.6 * t[-1]
    r = np.column_stack([speed * (t - nearest), np.full(len(t), 900.0), np.full(len(t), -50.0)])
    far = np.linalg.norm(r, axis=1)[:, None]
    m, earth = np.array([0.3, -0.8, 0.5]), np.array([0.5, 0.1, 0.85])
    field = (3.0 * r * (r @ m)[:, None] / far**2 - m) / far**3
    planted = problem.reference_jacobian * (field @ earth)
    planted *= 6.0 / np.abs(planted).max()
    noise = np.random.default_rng(5).normal(size=len(problem))
    given = replace(problem, residual=planted + noise)
    columns, look_elsewhere = passage(given, fit_joint(given, [], 1))
    assert missed(planted, columns(slice(None))) < 0.1
    assert 100 < look_elsewhere < 10 * len(problem)
