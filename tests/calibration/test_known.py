"""Prior knowledge can be rescaled, removed from a fit, and used as its start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gliders import Gliders

from magbridge.calibration.correct import correct
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import monomials
from magbridge.calibration.fitting.pose import Known, rescaling
from magbridge.calibration.model import Parameter
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.errors import CalibrationError
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import Prior


def test_rescaled_coefficients_are_the_same_field() -> None:
    rng = np.random.default_rng(0)
    exponents = full_order(2, 3)
    old = Parameter("a", "in", -1.0, 1.0, 0.1, 0.9), Parameter("b", "cm3", -200.0, 200.0, 5.0, 210.0)
    new = Parameter("a", "in", -2.0, 1.0, -0.5, 1.5), Parameter("b", "cm3", -50.0, 200.0, 75.0, 125.0)
    c = rng.normal(size=9 * len(exponents))
    changed = rescaling(exponents, old, new, 48_000.0, 51_000.0) @ c
    positions = np.column_stack([rng.uniform(-1, 1, 20), rng.uniform(-200, 200, 20)])
    before = monomials(positions, old, exponents) @ c.reshape(-1, 9)
    after = monomials(positions, new, exponents) @ changed.reshape(-1, 9)
    np.testing.assert_allclose(after[:, 6:], before[:, 6:], atol=1e-9)
    np.testing.assert_allclose(after[:, :6] / 51_000.0, before[:, :6] / 48_000.0, atol=1e-12)


def test_information_is_the_posterior_without_its_prior() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 5))
    J, h = root.T @ root, rng.normal(size=5)
    E, offset = rng.normal(size=(5, 5)), rng.normal(size=5)
    prior = Prior(np.diag(rng.uniform(0.5, 2.0, 5)), E, offset)
    known = np.linalg.inv(E @ np.linalg.inv(prior.precision) @ E.T)
    P = np.linalg.inv(J + known)
    reported = GaussianInformation.from_posterior(P @ (h + known @ offset), P, offset, np.linalg.inv(known))
    np.testing.assert_allclose(reported.precision, J, atol=1e-8)
    np.testing.assert_allclose(reported.vector, h, atol=1e-8)


def test_an_unknown_direction_is_not_told() -> None:
    J = np.diag([4.0, 9.0])
    v = np.array([1.0, 0.0])
    reported = GaussianInformation(J, J @ np.array([2.0, 3.0])).blurred(v, 10.0)
    np.testing.assert_allclose(np.linalg.inv(reported.precision), np.linalg.inv(J) + 100.0 * np.outer(v, v))
    np.testing.assert_allclose(np.linalg.solve(reported.precision, reported.vector), [2.0, 3.0])


def test_two_runs_are_enough_for_a_vehicle_that_is_known(glider: Gliders) -> None:
    one = glider(0)
    whole = fit(one.runs).calibration
    term = whole.terms[0]
    assert isinstance(term, Polynomial)
    covariance = whole.covariance + np.diag(np.full(len(whole.coefficients), 1e-2))
    known = Known(whole.parameters, term.exponents, whole.reference.field, whole.coefficients, covariance)
    two = one.runs.part(np.isin(one.runs.runs, np.unique(one.runs.runs)[:2]))
    truth = one.survey.reference

    def error(calibrated: object) -> float:
        found = correct(calibrated, one.survey.field, one.survey.parameters, one.survey.time)  # type: ignore[arg-type]
        return float(np.sqrt(np.mean((found.total - truth) ** 2)))

    least = error(whole)
    assert error(fit(two, known=known).calibration) < 1.1 * least
    assert error(fit(two).calibration) > 5.0 * least


def test_coefficients_of_other_masses_are_refused(glider: Gliders) -> None:
    runs = glider(0).runs
    part = runs.part(np.arange(len(runs)) % 4 == 0)
    parameters = (Parameter("battpos", "in", -1.0, 1.0, 0.0, 1.0),)
    known = Known(parameters, full_order(1, 1), 5e4, np.zeros(18), np.eye(18))
    with pytest.raises(
        CalibrationError, match=r"for battpos \[in\], and the log has battpos \[in\], ballast"
    ):
        fit(part, known=known)
    with pytest.raises(CalibrationError, match="no use where the coefficients are known"):
        fit(replace(part), known=known, vehicle={"battpos": {"at": (1, 0, 0), "travel": (0.1, 0, 0)}})
