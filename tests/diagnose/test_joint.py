"""Calibration, effects and noise at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose.compare.past import FAR
from magbridge.diagnose.compare.problem import pose
from magbridge.diagnose.compare.survey import Channel, Survey
from magbridge.diagnose.inference.joint import fit_joint

ROWS = 300


def test_numbers_of_one_size_that_say_the_same_share_what_they_say() -> None:
    """Two causes of one common size each, with a column twice or of nothing: their own sizes are what keeps them apart."""
    rng = np.random.default_rng(4)
    d = rng.normal(size=(ROWS, 3))
    survey = Survey(
        time=1.7e9 + 4.0 * np.arange(ROWS), field=5e4 * d / np.linalg.norm(d, axis=1)[:, None],
        reference=np.full(ROWS, 5e4), still=(), steps=np.where(np.arange(ROWS) > 0, 1, FAR), dive=np.arange(ROWS) // 50, place=None,
        attitude=None, learned=np.zeros(ROWS, bool), cycles=np.empty(0), source="made",
        channels={"p": Channel(np.linspace(-1.0, 1.0, ROWS), "in", ("position",))},
    )  # fmt: skip
    calibration = Calibration(
        parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),), terms=(Polynomial(exponents=((0,),)),),
        coefficients=np.zeros(9), covariance=np.diag(np.full(9, 1e-6)), noise=Noise(1.0), reference=Reference(5e4),
    )  # fmt: skip
    a, b = np.sin(np.arange(ROWS) / 7.0), np.sign(np.sin(np.arange(ROWS) / 40.0))
    problem = replace(pose(survey, calibration), residual=3.0 * a - 2.0 * b + rng.normal(size=ROWS))
    twice = [np.column_stack([x, x, 0.0 * x]) for x in (a, b)]
    fit = fit_joint(
        problem, [lambda rows, x=x: x[rows] for x in twice], 1, spectra=[np.ones((1, 3)), np.ones((1, 3))]
    )
    np.testing.assert_allclose(fit.coefficients, [1.5, 1.5, 0.0, -1.0, -1.0, 0.0], atol=0.1)
    assert np.isfinite(fit.log_likelihood)
