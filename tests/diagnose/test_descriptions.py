"""Test the descriptions of residuals without a named cause."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from posed import missed, right, thinned
from scipy.stats import multivariate_normal

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.masses import ActuatorOrder, Hysteresis
from magbridge.diagnose.descriptions import (
    Description,
    bends,
    crossing,
    delayed,
    descriptions,
    near_surface,
    response,
    swings,
)
from magbridge.diagnose.evidence import information
from magbridge.diagnose.joint import PRIOR_SIZES, Ridge, Statistic, fit_joint
from magbridge.diagnose.packets import Packets, packets
from magbridge.diagnose.problem import Problem, pose


def test_ridge_is_the_marginal_likelihood_of_a_common_size() -> None:
    """Compare with the density of the data with the prior integrated out, computed naively."""
    rng = np.random.default_rng(1)
    X, width = rng.normal(size=(60, 5)), np.array([3.0, 1.0, 1.0, 0.3, 0.0])
    y = X @ np.array([2.0, -1.0, 0.5, 0.0, 0.0]) + rng.normal(size=60)

    def density(g: float) -> float:
        return float(multivariate_normal.logpdf(y, cov=np.eye(60) + g * (X * width**2) @ X.T))

    best = Statistic(X.T @ X, width[None] ** 2).best(X.T @ y)
    assert 0.5 * best.ratio == pytest.approx(max(density(g) for g in PRIOR_SIZES) - density(0.0), abs=1e-8)
    gained = 0.5 * (y @ y - np.sum((y - X @ best.estimate) ** 2))
    assert gained - best.price == pytest.approx(0.5 * best.ratio, abs=1e-8)
    assert best.estimate[-1] == 0.0


def test_under_no_effect_twice_the_evidence_is_at_most_a_chi_square_of_one_freedom() -> None:
    rng = np.random.default_rng(2)
    X = rng.normal(size=(400, 40)) / np.arange(1, 41)
    statistic = Statistic(X.T @ X, np.ones((1, 40)))
    assert np.mean(statistic.ratio(X.T @ rng.normal(size=(400, 2000))) > 6.63) < 0.015


def test_a_converter_whose_steps_differ_is_described() -> None:
    """Signal-to-noise 10, in one level for each of 25 steps and channel."""
    rng = np.random.default_rng(3)
    reading = rng.uniform(-5e4, 5e4, (4000, 3))
    jacobian = reading / np.linalg.norm(reading, axis=1)[:, None]
    code = np.round(reading / 4000.0).astype(int)
    bent = np.sum(jacobian * np.take_along_axis(rng.normal(size=(26, 3)), code % 26, axis=0), axis=1)
    given = 10.0 * bent / np.linalg.norm(bent) + rng.normal(size=4000)
    X = response(reading, jacobian.__getitem__)(slice(None))
    S, b = X.T @ X, X.T @ given
    assert Statistic(S, np.array([width**2 for _, width in bends()])).best(b).ratio > 2.0 * 10.0


@pytest.mark.parametrize("width", [600.0, 2500.0])
def test_a_feedback_that_falters_at_zero_is_described(width: float) -> None:
    """A dead zone, rounded, with whatever gain and offset a calibration would take of it taken."""
    rng = np.random.default_rng(4)
    reading = rng.uniform(-5e4, 5e4, (20_000, 3))
    x = reading[:, :1] / width
    dead = np.tanh(x) * np.exp(-np.abs(x))
    X = crossing(reading, np.eye(3)[np.zeros(len(x), dtype=int)].__getitem__)(slice(None))
    gain = np.column_stack([np.ones_like(x), x])
    X, y = (a - gain @ np.linalg.lstsq(gain, a, rcond=None)[0] for a in (X, dead[:, 0]))
    assert missed(y, X) < 0.1


def left_of(y: np.ndarray, X: np.ndarray) -> float:
    """Return the fraction of the power of y (n,) that the columns X (n, k) and a constant leave."""
    return missed(y - y.mean(), X - X.mean(axis=0))


def followed(time: np.ndarray, x: np.ndarray, lag: float) -> np.ndarray:
    """Return y with ``dy/dt = (x - y) / lag``, naively."""
    y = x.copy()
    for k in range(1, len(x)):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * -np.expm1((time[k - 1] - time[k]) / lag)
    return y


def test_a_slab_that_follows_a_temperature_is_described() -> None:
    """The description has the centre's two slowest modes (Carslaw & Jaeger 1959, sec. 3.4), in real dives."""
    time = 4.0 * np.arange(5400.0)
    water = np.tanh(3.0 * np.sin(2.0 * np.pi * time / 5500.0)) + time / time[-1]
    core = followed(time, water, 1800.0) - followed(time, water, 200.0) / 3.0
    X = delayed(time, water)(slice(None))
    assert left_of(core, X) < 1e-3
    assert left_of(core, X[:, :1]) > 0.1


@pytest.mark.parametrize("lag", [5.0, 20.0])
def test_what_swings_out_in_turns_is_described(lag: float) -> None:
    time = 4.0 * np.arange(3000.0)
    rate = np.where(time % 700.0 < 60.0, np.where(time % 1400.0 < 700.0, 1.0, -0.4), 0.0)
    swung = followed(time, rate, lag)
    assert left_of(swung - 0.5 * swung**2, swings(time, rate)(slice(None))) < 0.05


def test_what_the_sun_warms_at_the_surface_is_described() -> None:
    time = 4.0 * np.arange(5400.0)
    depth = np.abs((time % 5000.0) - 2500.0) * 0.08
    warm = followed(time, np.exp(-depth / 8.0), 500.0)
    assert left_of(warm, near_surface(time, depth)(slice(None))) < 0.02


def test_a_sensitivity_that_follows_a_channel_is_not_an_offset(
    problem: Problem, listed: list[Description]
) -> None:
    offset, scale = (
        next(c for c in CAUSES[name].candidates(problem) if c.channel == "sensor_temperature")
        for name in ("temperature_offset", "temperature_scale")
    )
    of_channel = [one for one in listed if one.channel == "sensor_temperature" and not one.remembers]
    assert [one.scales for one in of_channel] == [False, False, True]
    assert [one.covers([offset]) for one in of_channel] == [True, True, False]
    assert [one.covers([scale]) for one in of_channel] == [False, False, True]


def test_functions_of_the_direction_and_of_the_reading_hold_a_bend(
    problem: Problem, listed: list[Description]
) -> None:
    """The functions hold a nonlinearity to 1 % of the part that a calibration's constants do not hold."""
    rows = slice(0, len(problem))
    (bend, more, _), (step, *_) = (
        CAUSES[name].candidates(problem) for name in ("nonlinearity", "offset_step")
    )
    bent = np.hstack([bend.columns(rows), more.columns(rows)])
    held = [one for one in listed if one.holds(bend)]
    assert len(held) == 2

    def remaining_power(X: np.ndarray) -> float:
        scale = np.linalg.norm(X, axis=0)
        return float(np.linalg.norm(bent - X / scale @ np.linalg.lstsq(X / scale, bent, rcond=1e-12)[0]))

    for one in held:
        assert remaining_power(np.hstack([problem.jacobian, one.columns(rows)])) < 0.01 * remaining_power(
            problem.jacobian
        )
        assert one.covers([bend])
        assert not one.covers([bend, step])
        assert not one.covers([])


def test_a_curve_through_a_mass_position_covers_its_order_and_its_past_the_hysteresis(
    problem: Problem, listed: list[Description]
) -> None:
    order = ActuatorOrder().candidates(problem)[0]
    back = next(one for one in Hysteresis().candidates(problem) if one.channel == "battpos")
    curve, past, *late = (one for one in listed if one.channel == "battpos")
    assert (curve.covers([order]), curve.covers([back])) == (True, False)
    assert (past.covers([order]), past.covers([back])) == (False, True)
    assert not any(one.covers([order]) or one.covers([back]) for one in late)


def test_descriptions_of_a_long_log_do_not_fill_the_memory(problem: Problem) -> None:
    fit = fit_joint(problem, [], 1)
    descriptions(problem, fit)  # what causes share is cached now
    tracemalloc.start()
    listed = descriptions(problem, fit)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    columns = sum(len(one.widths[0][1]) for one in listed)
    assert held < 45 * problem.residual.nbytes < columns * problem.residual.nbytes / 10


# ---- what rings for a while --------------------------------------------------------------------------------


def drawn(problem: Problem, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return noise of unit variance on a log with gaps."""
    place = np.cumsum(np.append(0, problem.survey.steps[1:]))
    r = rng.normal(size=int(place[-1]) + 1)
    for k in range(1, len(r)):
        r[k] = rho * r[k - 1] + np.sqrt(1.0 - rho**2) * r[k]
    return np.asarray(r[place])


def fitted(given: Problem) -> tuple[Packets, Ridge]:
    """Return the packets of a log, and the best estimate of their sizes."""
    base = fit_joint(given, [], 1)
    found = packets(given, base)
    assert found is not None
    info = information(given, base.noise, base, [found.columns])
    return found, Statistic(info.matrix, np.ones((1, len(info.score)))).best(info.score)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_two_packets_are_found_where_they_are_in_noise_of_any_correlation(
    problem: Problem, rho: float
) -> None:
    n, rng = len(problem), np.random.default_rng(3)
    t = np.arange(n)
    planted = np.zeros(n)
    for moment, period, length in ((0.3 * n, 40.0, 90.0), (0.7 * n, 25.0, 30.0)):
        planted += 4.0 * np.exp(-0.5 * ((t - moment) / length) ** 2) * np.cos(2 * np.pi * t / period + 1.0)
    noise = drawn(problem, rho, rng)
    given = replace(problem, residual=problem.reference_jacobian * planted + noise)
    found, best = fitted(given)
    estimate = found.columns(slice(None)) @ best.estimate
    planted *= problem.reference_jacobian
    assert np.sum((estimate - planted) ** 2) < np.sum(planted**2) / 3.0
    assert 0.5 * best.ratio - np.log(found.look_elsewhere) > 10.0
    assert 20.0 < found.period / np.median(np.diff(problem.survey.time)) < 50.0


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_noise_has_no_packet_that_is_worth_its_place(problem: Problem, rho: float) -> None:
    rng = np.random.default_rng(4)
    worth = []
    for _ in range(30):
        given = replace(problem, residual=drawn(problem, rho, rng))
        found = packets(given, fit_joint(given, [], 1))
        worth.append(found is not None)
    assert sum(worth) <= 6


@pytest.mark.parametrize("kept", ["seven of eight", "a hole", "half at half the rate"])
def test_a_packet_keeps_its_period_and_place_where_samples_are_lost(kept: str) -> None:
    whole, rng = right(4000), np.random.default_rng(5)
    n, here = len(whole), np.ones(4000, bool)
    if kept == "seven of eight":
        here = rng.random(n) > 0.125
    elif kept == "a hole":
        here[1500:2400] = False
    else:
        here[1 : n // 2 : 2] = False
    t = np.arange(n)
    planted = 2.5 * np.exp(-0.5 * ((t - 1200.0) / 90.0) ** 2) * np.cos(2 * np.pi * t / 41.0 + 1.0)
    log = pose(thinned(whole.survey, here), whole.calibration)
    planted = log.reference_jacobian * planted[here]
    given = replace(log, residual=planted + drawn(log, 0.5, rng))
    found, best = fitted(given)
    assert np.sum((found.columns(slice(None)) @ best.estimate - planted) ** 2) < 0.2 * np.sum(planted**2)
    assert found.period == pytest.approx(4.0 * 41.0, rel=0.1)
