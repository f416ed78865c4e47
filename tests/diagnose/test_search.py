"""Test the search on artificial residuals, and the evidence that it compares."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from posed import calibrated, candidate, missed, right, surveyed
from scipy.signal import lfilter
from scipy.stats import chi2, ncx2

from magbridge.calibration.effects import TimeEffect
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.causes.reference import ReferenceBias
from magbridge.diagnose.columns import Candidate, GridPoint
from magbridge.diagnose.evidence import (
    FALSE_ALARM_RATE,
    ODDS,
    Information,
    bayes_factor_threshold,
    evidence_of,
    isolability,
    likeness,
    log_bayes,
    log_odds,
    look_elsewhere_factors,
    score,
)
from magbridge.diagnose.joint import RIDGE, fit_joint
from magbridge.diagnose.leftover import varying
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.run import accept, odds_over_random_walk
from magbridge.diagnose.search import beside_slow_noise, search
from magbridge.diagnose.state import SearchState


def fault(cause: str, x: NDArray[np.float64], width: float) -> Candidate:
    """Return a candidate fault with one coefficient that adds x (n,) times `width`, nT."""
    effects = (TimeEffect(cause=cause, shape="step", start=0.0),)
    return candidate(cause, width * x, width=np.array([width]), effects=effects)


def turning(n: int) -> tuple[Problem, list[Candidate], NDArray[np.float64]]:
    """Return the problem of three turns, candidates for a drift and steps, and the time (n,) from 0 to 1."""
    turn, t = np.linspace(0.0, 6.0 * np.pi, n), np.linspace(0.0, 1.0, n)
    directions = np.column_stack([0.4 * np.cos(turn), 0.4 * np.sin(turn), np.full(n, 0.9)])
    problem = pose(surveyed(directions, np.linspace(-1.0, 1.0, n)), calibrated(np.zeros(9), 1e-6))
    steps = [fault("offset_step", (t > at).astype(float), 10.0) for at in np.arange(0.05, 1.0, 0.05)]
    return problem, [fault("offset_drift", t, 10.0), *steps], t


@pytest.mark.parametrize(("functions", "rough", "warm"), [(60, 20.0, 60.0), (150, 6.0, 15.0)])
def test_noise_does_not_swallow_what_two_causes_do_together(
    functions: int, rough: float, warm: float
) -> None:
    """A warming over a rough crustal field: given one of them, slow noise describes the other."""
    rng = np.random.default_rng(2)
    n = 3000
    t = np.linspace(0.0, 1.0, n)
    warming = 1.0 - np.exp(-t / 0.1)
    places = np.linspace(0.0, 1.0, functions)
    rock = np.exp(-0.5 * ((t[:, None] - places) / (0.6 / functions)) ** 2)
    noise = lfilter([0.6], [1.0, -0.8], rng.normal(size=n))
    problem = replace(right(n), residual=noise + warm * warming + rough * rock @ rng.normal(size=functions))
    chart = candidate("map_error", rock, spectra=np.ones((1, functions)))
    step = fault("offset_step", (t > 0.1).astype(float), 10.0)
    outcome = search(problem, [fault("temperature_offset", warming, 10.0), step, chart], 3)
    assert {h.candidate.cause for h in outcome.chosen} == {"temperature_offset", "map_error"}
    assert outcome.fit.noise.slowest < 20.0 < 80.0 < outcome.null.noise.slowest


@pytest.mark.parametrize(
    ("noise", "size", "named"), [("flicker", 0.0, set()), ("white", 0.25, {"offset_step"})]
)
def test_flicker_noise_gets_no_name_and_a_step_in_white_noise_its_own(
    noise: str, size: float, named: set[str]
) -> None:
    """Noise of power 1/f down to the length of the log is slower than any autoregression of 13 samples."""
    n, rng = 6000, np.random.default_rng(0)
    problem, candidates, t = turning(n)
    white, power = rng.normal(size=(n, 3)), 1.0 + 0.3 / np.maximum(np.fft.rfftfreq(n), 1.0 / n)
    coloured = np.fft.irfft(np.fft.rfft(white, axis=0) * np.sqrt(power)[:, None], n, axis=0)
    read = np.sum(problem.jacobian[:, 6:] * (coloured if noise == "flicker" else white), axis=1)
    problem = replace(problem, residual=read + size * (t > 0.5))
    outcome = beside_slow_noise(search(problem, candidates, 2), candidates, 2)
    assert {h.candidate.cause for h in outcome.chosen} == named
    slow = outcome.problem.slow_noise(outcome.fit.z)
    assert (np.std(slow) > 0.3 * np.std(read)) == (noise == "flicker")


def test_a_further_cause_must_predict_better_than_a_free_description() -> None:
    rng, n = np.random.default_rng(4), 600
    shapes = {"offset_step": (np.arange(n) > 200.0).astype(float), "current_field": rng.normal(size=n)}
    candidates = [fault(cause, shape, 10.0) for cause, shape in shapes.items()]
    signal = 5.0 * shapes["offset_step"] + 1.0 * shapes["current_field"]
    problem = replace(right(n), residual=signal + rng.normal(size=n))
    for worth, expected in ((-np.inf, {"offset_step", "current_field"}), (np.inf, {"offset_step"})):
        found = search(problem, candidates, 2, lambda *_, worth=worth: worth)
        assert {one.candidate.cause for one in found.chosen} == expected


def test_what_nature_cannot_do_is_the_vehicles() -> None:
    """Of two causes of one shape, the reference explains at most its usual error."""
    rng = np.random.default_rng(1)
    n = 600
    x = np.linspace(-1.0, 1.0, n)
    drifting = fault("offset_drift", x, 50.0)
    natural = replace(fault("diurnal_variation", x, 20.0), effects=())
    problem = replace(right(n), residual=150.0 * x + rng.normal(size=n))
    fit = SearchState(problem, [drifting, natural], 1, 2).fit([drifting, natural])
    drift, daily = fit.coefficients * [50.0, 20.0]
    assert drift + daily == pytest.approx(150.0, abs=1.0)
    assert daily == pytest.approx(150.0 * 20.0**2 / (20.0**2 + 50.0**2 / 0.1), rel=0.05)


def test_a_main_field_model_may_be_off_by_140_nanotesla() -> None:
    """At many sites the crustal field is likely; a fault of the vehicle that imitates it must not win."""
    rng = np.random.default_rng(1)
    problem = right(600)
    noise = rng.normal(size=600)
    [bias] = ReferenceBias().candidates(problem)
    small, large = (
        SearchState(replace(problem, residual=noise + size * problem.reference_jacobian), [bias], 1, 1)
        .fit([bias])
        .log_likelihood
        for size in (10.0, 140.0)
    )
    assert small - 2.0 < large < small


@pytest.mark.parametrize("walks", [True, False])
def test_a_slow_cause_is_separated_from_a_random_walk_only_where_it_is_clear(walks: bool) -> None:
    """A walk that passes for a drift may be noise; a step of S/N 40 in white noise is none."""
    n, rng = 3000, np.random.default_rng(0)
    problem, candidates, t = turning(n)
    noise, walk = rng.normal(size=n), np.cumsum(rng.normal(size=n)) / np.sqrt(n)
    problem = replace(problem, residual=noise + (walk if walks else 80.0 / np.sqrt(n) * (t > 0.5)))
    outcome = beside_slow_noise(search(problem, candidates, 2), candidates, 2)
    (named,) = outcome.chosen
    assert (odds_over_random_walk(outcome, named) > ODDS) != walks


# ---- names against descriptions of the whole ---------------------------------------------------------------


ROWS = 300


def test_a_name_is_asserted_possible_or_ruled_out() -> None:
    """A name is worth less the more it was chosen from, but possible until beaten by its margin."""
    problem = right(ROWS)
    bent = 8.0 * (problem.survey.field / 5e4).prod(axis=1)
    problem = replace(problem, residual=bent + np.random.default_rng(9).normal(size=ROWS))
    name = candidate("a", bent)
    outcome = search(problem, [name], 1)
    output = []
    for price in np.arange(4.0, 9.0) * bayes_factor_threshold(outcome.chosen[0].ratio):
        stands, rest = accept(problem, replace(outcome, look_elsewhere={"a": float(np.exp(price))}))
        output.append(
            "asserted" if stands else "possible" if rest is not None and rest.within else "ruled out"
        )
    assert output == sorted(output)
    assert output.count("possible") == 1
    assert {"asserted", "ruled out"} < set(output)


def test_dives_left_out_overrule_a_name_that_fits() -> None:
    """For any prior, a name that only resembles the truth predicts less well than a description."""
    problem, rng = right(ROWS), np.random.default_rng(10)
    bent = 8.0 * (problem.survey.field / 5e4).prod(axis=1)
    problem = replace(problem, residual=bent + rng.normal(size=ROWS))
    for share, named in ((0.0, True), (0.5, False)):
        alike = candidate(
            "a", bent + share * bent.std() * rng.normal(size=ROWS), point=GridPoint(likelier=300.0)
        )
        assert accept(problem, search(problem, [alike], 1))[0] == named


@pytest.mark.parametrize(
    ("follows", "waves", "named"),
    [(0.0, 0, True), (0.2, 0, True), (1.0, 0, False), (0.0, 3, False), (0.0, 20, False)],
)
def test_a_name_whose_size_follows_something_else_or_varies_in_time_is_not_asserted(
    follows: float, waves: int, named: bool
) -> None:
    """A payload's current, with leads that a moving mass separates, or beside one without telemetry."""
    problem, rng = right(ROWS), np.random.default_rng(10)
    drawn = np.where(np.sin(np.arange(ROWS) / 3.0) > 0.3, 1.0, 0.0)
    place = problem.survey.channels["p"].values
    power = 1.0 + follows * place / np.std(place[drawn > 0.0])
    if waves:
        power += 0.8 * np.cos(np.pi * waves * np.arange(ROWS) / ROWS)
    problem = replace(problem, residual=1.5 * drawn * power + rng.normal(size=ROWS))
    name = candidate("a", drawn, channel="amps")
    outcome = search(problem, [name], 1)
    assert [h.candidate for h in outcome.chosen] == [name]
    asserted, rest = accept(problem, outcome)
    assert asserted == named
    assert named or rest is not None


@pytest.mark.parametrize("of_iron", [False, True])
def test_a_step_that_depends_on_attitude_as_soft_iron_does_is_no_offset_step(of_iron: bool) -> None:
    """Iron that the vehicle has lost takes its induced moment with it."""
    n, rng = 1000, np.random.default_rng(10)
    heading, climbs = np.linspace(0.0, 60.0, n), np.sign(np.sin(np.arange(n) / 9.0))
    directions = np.stack([0.6 * np.cos(heading), 0.6 * np.sin(heading), 0.8 + 0.3 * climbs], axis=1)
    problem = pose(surveyed(directions, np.linspace(-1.0, 1.0, n)), calibrated(np.zeros(9), 1e-6))
    after, u = np.arange(n) > 600, problem.survey.field / 5e4
    change = 3.0 * (u @ [1.0, -1.0, 1.0]) ** 2 if of_iron else u @ [1.0, -1.0, 1.0]
    problem = replace(problem, residual=change * after + rng.normal(size=n))
    step = TimeEffect(cause="a", shape="step", start=0.0)
    name = candidate("a", u * after[:, None], effects=(step,))
    outcome = search(problem, [name], 1)
    assert len(outcome.chosen) == 1
    assert accept(problem, outcome)[0] is not of_iron


def test_the_size_of_a_cause_may_follow_all_but_its_own_channel(problem: Problem) -> None:
    """An effect of pressure and pitch together is held; the remainder is the square of the pressure."""
    survey, rows = problem.survey, slice(0, len(problem))
    assert survey.attitude is not None
    squeezed = next(c for c in CAUSES["pressure_offset"].candidates(problem) if c.channel == "depth")
    described = varying(problem, squeezed, {"pressure_offset": 2.0})
    assert described is not None
    X = described.columns(rows)
    assert X.shape[1] == described.widths[0][1].size

    own = squeezed.columns(rows)[:, 0]
    assert missed(own * (2.0 - survey.attitude[:, 1]), X) < 1e-9
    assert missed(own * np.cos(np.radians(survey.attitude[:, 2])), X) < 1e-9
    assert missed(own * survey.channels["depth"].values ** 2, X) > 1e-3
    assert described.covers([squeezed])
    slow = replace(squeezed, spectra=np.ones((1, squeezed.size)))
    assert varying(problem, slow, {"pressure_offset": 2.0}) is None


# ---- The evidence of a likelihood ratio, given the prior of its coefficients -------------------------------


def sized(cause: str, size: int = 1, **more: object) -> Candidate:
    """Return a candidate with a given number of coefficients."""
    return candidate(cause, np.zeros((1, size)), **more)


def test_what_cannot_be_negative_has_twice_the_prior_where_it_is() -> None:
    """Compare with the integral over half a Gaussian prior of the likeliest size."""
    estimate = 1.8
    size = np.sqrt(estimate**2 - 1.0)
    b = np.linspace(0.0, 12.0, 20_001)
    prior = np.sqrt(2.0 / np.pi) / size * np.exp(-0.5 * (b / size) ** 2)
    exact = np.log(np.trapezoid(prior * np.exp(b * estimate - 0.5 * b**2), b))
    one_sided = evidence_of(sized("filter_lag", positive=True), estimate**2, 1)
    assert one_sided == pytest.approx(exact, abs=0.06)
    assert one_sided - log_bayes(estimate**2, 1) == pytest.approx(np.log(2.0), abs=0.05)


@pytest.mark.parametrize(
    ("one", "least"),
    [
        (sized("filter_lag", positive=True), 0.08),
        (sized("map_error", 6, spectra=np.array([np.ones(6), 2.0 ** -np.arange(6)])), 0.0),
    ],
)
def test_a_size_that_cannot_be_negative_has_one_tail(one: Candidate, least: float) -> None:
    """Where there is none, no more than the level is found; of a single number, no less either."""
    S = np.diag(30.0 ** -np.linspace(0.0, 1.0, one.size)) * 100.0
    draws = np.random.default_rng(5).standard_normal((2000, one.size)) * np.sqrt(np.diag(S))
    ratios = [score(Information(S, b, np.zeros((0, 0))), slice(None), one).ratio for b in draws]
    assert least <= np.mean(one.tail * chi2.sf(ratios, 1) < 0.1) < 0.12


def test_each_spectrum_that_was_tried_has_its_price() -> None:
    """A choice among three spectra costs log 3, as a choice among three hypotheses does."""
    one, three = (sized("map_error", 6, spectra=np.ones((k, 6))) for k in (1, 3))
    odds = [log_odds(200.0, [chart], {"map_error": 1.0}, 0.0) for chart in (one, three)]
    assert odds[0] - odds[1] == pytest.approx(np.log(3.0))


@pytest.mark.parametrize(("correlation", "expected"), [(0.0, 2.0), (1.0, 1.0)])
def test_number_of_hypotheses_counts_those_that_differ(correlation: float, expected: float) -> None:
    """Two orthogonal candidates are two hypotheses, two equal ones are one; each of one size adds one."""
    S = 100.0 * np.array([[1.0, correlation, 0.0], [correlation, 1.0, 0.0], [0.0, 0.0, 1.0]])
    info = Information(S, np.zeros(3), np.zeros((0, 3)))
    steps = [sized("offset_step"), sized("offset_step")]
    chart = sized("offset_step", spectra=np.ones((1, 1)))
    places = [slice(k, k + 1) for k in range(3)]
    assert look_elsewhere_factors(info, steps, places)["offset_step"] == pytest.approx(expected, abs=0.02)
    more = look_elsewhere_factors(info, [*steps, chart], places)["offset_step"]
    assert more == pytest.approx(expected + 1.0, abs=0.02)


def test_visible_size_is_found_with_a_probability_of_95_percent() -> None:
    """Compare with the power of the chi-square test at the false-alarm rate of one of twelve hypotheses."""
    step = candidate("offset_step", np.zeros((1, 1)), width=np.array([10.0]))
    info = Information(np.array([[400.0]]), np.zeros(1), np.zeros((0, 1)))
    ((_, _, sizes),) = isolability([step], info, {"offset_step": 3.0}, 4, {}).visible
    ((size, _),) = sizes.values()
    threshold = chi2.isf(FALSE_ALARM_RATE / (12.0 * step.tail), 1)
    assert ncx2.sf(threshold, 1, 400.0 * (size / 10.0) ** 2) == pytest.approx(0.95, abs=1e-6)


def test_likeness_is_the_correlation_of_two_columns_less_what_a_prior_prevents() -> None:
    """Free coefficients imitate a signature in full; one of a common size only up to its prior."""
    info = Information(np.array([[4.0, 1.2], [1.2, 1.0]]), np.zeros(2), np.zeros((0, 2)))
    free, process = sized("late"), sized("map_error", spectra=np.ones((1, 1)))
    a, b = slice(0, 1), slice(1, 2)
    assert likeness(info, free, a, free, b) == pytest.approx(0.6, abs=1e-3)
    # shares of power: 1.2²/(1 + 1)/4 and 1.2²/(4 + 1)/1
    assert likeness(info, process, a, process, b) == pytest.approx(np.sqrt(1.2**2 / 5.0))


def test_projection_of_a_model_is_the_joint_least_squares_solution() -> None:
    """Compare with the normal equations of calibration, model and candidate, solved at once."""
    rng = np.random.default_rng(8)
    Z, C, B = (rng.normal(size=(40, size)) for size in (3, 2, 2))
    y, prior = rng.normal(size=40), np.array([0.5, 0.5, 0.5, 2.0, 3.0])
    base = SimpleNamespace(z=np.zeros(3), coefficients=np.zeros(2), prior=prior)
    # candidate and model, with the calibration projected out
    X = np.hstack([B, C])
    K = np.linalg.solve(Z.T @ Z + np.diag(prior[:3]), Z.T @ X)
    info = Information(X.T @ (X - Z @ K), X.T @ y - K.T @ (Z.T @ y), np.asarray(K, float))
    found = info.fitted(base)  # type: ignore[arg-type]
    both = np.hstack([Z, C])
    K = np.linalg.solve(both.T @ both + np.diag(prior), both.T @ B)
    np.testing.assert_allclose(found.matrix, B.T @ (B - both @ K))
    np.testing.assert_allclose(found.score, B.T @ y - K.T @ (both.T @ y))
    np.testing.assert_allclose(found.shift, K)


def test_a_score_is_the_ratio_its_evidence_and_the_shrunk_estimate() -> None:
    S, b = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([6.0, -3.0])
    info = Information(S, b, np.zeros((1, 2)))
    one = sized("late", 2)
    found = score(info, slice(0, 2), one)
    assert found.ratio == pytest.approx(b @ np.linalg.solve(S, b))
    assert found.evidence == pytest.approx(float(log_bayes(found.ratio, 2)))
    np.testing.assert_allclose(found.estimate, np.linalg.solve(S + np.eye(2), b))
    assert evidence_of(one, 12.0, 2) == float(log_bayes(12.0, 2)), "a size of either sign has two tails"
    positive = score(info, slice(1, 2), sized("late", 1, positive=True))
    assert (positive.ratio, positive.evidence, positive.freedom) == (0.0, 0.0, 1)
    assert positive.estimate.tolist() == [0.0]


# ---- calibration, effects and noise at once ----------------------------------------------------------------


def test_numbers_of_one_size_that_say_the_same_share_what_they_say() -> None:
    """Two causes with a common size each, a column double or empty: only their sizes distinguish them."""
    rng = np.random.default_rng(4)
    a, b = np.sin(np.arange(ROWS) / 7.0), np.sign(np.sin(np.arange(ROWS) / 40.0))
    problem = replace(right(ROWS), residual=3.0 * a - 2.0 * b + rng.normal(size=ROWS))
    twice = [np.column_stack([x, x, 0.0 * x]) for x in (a, b)]
    fit = fit_joint(problem, [x.__getitem__ for x in twice], 1, spectra=[np.ones((1, 3)), np.ones((1, 3))])
    np.testing.assert_allclose(fit.coefficients, [1.5, 1.5, 0.0, -1.0, -1.0, 0.0], atol=0.1)


def test_a_likelihood_is_the_gaussian_s_less_what_the_priors_cost() -> None:
    """White noise at its likeliest size, and an effect that no noise with a memory takes for its own."""
    rng = np.random.default_rng(5)
    column = rng.choice([-1.0, 1.0], (ROWS, 1))
    y = 3.0 * column[:, 0] + rng.normal(size=ROWS)
    problem = replace(right(ROWS), residual=y)
    fits = [fit_joint(problem, [], 1), fit_joint(problem, [column.__getitem__], 1)]
    naive = [
        -0.5 * ROWS * (np.log(2.0 * np.pi * np.mean(residual**2)) + 1.0)
        for residual in (fit.residual for fit in fits)
    ]
    gained = fits[1].log_likelihood - fits[0].log_likelihood
    assert gained == pytest.approx(naive[1] - naive[0] - 0.5 * RIDGE * fits[1].coefficients[0] ** 2, rel=0.05)
    assert gained > 200.0
    assert fits[1].coefficients[0] == pytest.approx(3.0, abs=0.2)
