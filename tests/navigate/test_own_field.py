"""Test the likelihood of a track in an unmapped field, its bound, and the sampler that uses both."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from magbridge.arrays import FloatArray
from magbridge.navigate.model import Block
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.own_survey import OwnField, drift_functions, own_bound
from magbridge.navigate.particles import sample

OPTIONS = NavigationOptions(start_sigma=30.0, current_sigma=0.05, bias_sigma=2.0, bias_time=3600.0)
COUNT = 40


@pytest.fixture(scope="module")
def field() -> OwnField:
    rng = np.random.default_rng(1)
    place = np.cumsum(100.0 * rng.normal(size=(COUNT, 2)), axis=0)
    blocks = [
        Block(int(6e8 * k), 49.0, -57.0, 30.0 * rng.normal(), 0.2, *(0.01 * rng.normal(size=2)))
        for k in range(COUNT)
    ]
    return OwnField(blocks, place, OPTIONS)


@pytest.fixture(scope="module")
def u(field: OwnField) -> FloatArray:
    return np.random.default_rng(2).normal(size=field.q)


def test_likelihood_is_that_of_a_normal_and_its_slope_is_its_own(field: OwnField, u: FloatArray) -> None:
    """Against scipy's normal, where only differences count; and against steps of 1e-5."""

    def naive(at: FloatArray, count: int) -> float:
        d = field.moved(at)[:count]
        y = field.anomaly[:count] - field.mean - (field.slope[:count] * d).sum(axis=1)
        K, _ = field.covariance(field.place[:count] + d, at)
        return float(multivariate_normal(np.zeros(count), K).logpdf(y))

    for count in (COUNT // 2, COUNT):
        value, slope = field.log_likelihood(u, count)
        off, _ = field.log_likelihood(0.9 * u, count)
        assert value - off == pytest.approx(naive(u, count) - naive(0.9 * u, count), rel=1e-6)
        steps = 1e-5 * np.eye(field.q)
        found = [
            (field.log_likelihood(u + h, count)[0] - field.log_likelihood(u - h, count)[0]) / 2e-5
            for h in steps
        ]
        np.testing.assert_allclose(slope, found, atol=1e-4 * np.abs(slope).max())


def test_drift_has_the_covariance_of_the_filter_s_model() -> None:
    """At the end of a day, in closed form: start, random walk, and a Gauss-Markov current's integral."""
    time = np.linspace(0.0, 86_400.0, 50)
    variance = (drift_functions(time, OPTIONS)[-1] ** 2).sum()
    tau, T = OPTIONS.current_time, time[-1]
    carried = 2.0 * OPTIONS.current_sigma**2 * tau * (T - tau * (1.0 - np.exp(-T / tau)))
    assert variance == pytest.approx(30.0**2 + carried + OPTIONS.drift**2 * T, rel=0.02)


def test_bound_is_that_of_field_and_drift_together(field: OwnField, u: FloatArray) -> None:
    """The information of field values and drift, written out and inverted; and no slope tells nothing."""
    rng = np.random.default_rng(3)
    slopes = 0.05 * rng.normal(size=(COUNT, 2))
    K, R = field.covariance(field.place, u)
    felt = slopes + field.slope
    G = np.hstack([felt[:, :1] * field.drift, felt[:, 1:] * field.drift])
    J = np.block([
        [np.linalg.inv(K - np.diag(R)) + np.diag(1 / R), G / R[:, None]],
        [(G / R[:, None]).T, np.eye(2 * field.r) + G.T @ (G / R[:, None])],
    ])  # fmt: skip
    P = np.linalg.inv(J)[COUNT:, COUNT:].reshape(2, field.r, 2, field.r)
    joint = np.einsum("nr,arbs,ns->nab", field.drift, P, field.drift)
    np.testing.assert_allclose(own_bound(field, field.place, slopes, u), joint, rtol=1e-3, atol=1e-3)
    alone = own_bound(field, field.place, -field.slope, u)
    np.testing.assert_allclose(alone[:, 0, 0], (field.drift**2).sum(axis=1))
    unknown = own_bound(field, np.full((COUNT, 2), np.nan), slopes, u)
    np.testing.assert_allclose(unknown, alone)


def test_sampler_finds_a_normal_and_both_of_two_places() -> None:
    """y = 2 u_0 + noise, of which 1, 5, 20 are seen: exact mean and sigma; and u_1² = 4 has two answers."""
    y = 2.0 * 0.7 + 0.5 * np.random.default_rng(5).normal(size=20)

    def likelihood(u: FloatArray, count: int) -> tuple[float, FloatArray]:
        off, two = y[:count] - 2.0 * u[0], u[1] ** 2 - 4.0
        value = -0.5 * float(off @ off) / 0.25 - 0.5 * two * two
        return value, np.array([2.0 * off.sum() / 0.25, -2.0 * u[1] * two, 0.0])

    found = sample(likelihood, 3, [1, 5, 20], 200)
    precision = 1.0 + 20 * 4.0 / 0.25
    mean, sigma = found.mean(axis=0), found.std(axis=0)
    assert mean[0] == pytest.approx(2.0 * y.sum() / 0.25 / precision, abs=3.0 / (200 * precision) ** 0.5)
    assert sigma[0] == pytest.approx(precision**-0.5, rel=0.2)
    assert 0.3 < (found[:, 1] > 0.0).mean() < 0.7
    x = np.linspace(0.0, 4.0, 400)
    density = np.exp(-0.5 * (x**2 - 4.0) ** 2 - 0.5 * x**2)
    assert np.abs(found[:, 1]).mean() == pytest.approx((x * density).sum() / density.sum(), abs=0.05)
    assert abs(mean[2]) < 0.25
    assert sigma[2] == pytest.approx(1.0, rel=0.2)
