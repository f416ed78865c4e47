"""What tests of a diagnosis share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.lowpass import unfiltered
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.diagnose.compare.past import FAR
from magbridge.diagnose.compare.problem import Problem, pose
from magbridge.diagnose.compare.survey import Channel, Survey
from magbridge.diagnose.compare.take import take
from magbridge.diagnose.inference.joint import fit_joint
from magbridge.diagnose.unexplained.descriptions import Description, descriptions
from sitl import load, simulate
from sitl.dataset import segments


@pytest.fixture(scope="session")
def problem() -> Problem:
    """The demo's survey against the calibration of its own runs."""
    scenario = load("demo")
    parts = segments(simulate(scenario, 2))
    learned = unfiltered(
        observations(parts["calibration"], ("battpos", "ballast")), scenario.instrument.corner
    )
    calibration = fit(learned, "auto").calibration
    return pose(take([parts["survey"]], calibration), calibration)


@pytest.fixture(scope="session")
def listed(problem: Problem) -> list[Description]:
    """Its descriptions without a name, beside noise alone."""
    return descriptions(problem, fit_joint(problem, [], 1))


def _right(rows: int) -> Problem:
    """A vehicle that is right but for noise."""
    rng = np.random.default_rng(4)
    d = rng.normal(size=(rows, 3))
    survey = Survey(
        time=1.7e9 + 4.0 * np.arange(float(rows)), field=5e4 * d / np.linalg.norm(d, axis=1)[:, None],
        reference=np.full(rows, 5e4), still=(), steps=np.where(np.arange(rows) > 0, 1, FAR),
        dive=np.arange(rows) // 50, place=None, attitude=None, learned=np.zeros(rows, bool),
        cycles=np.empty(0), source="made",
        channels={"p": Channel(np.linspace(-1.0, 1.0, rows), "in", ("position",))},
    )  # fmt: skip
    calibration = Calibration(
        parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),), terms=(Polynomial(exponents=((0,),)),),
        coefficients=np.zeros(9), covariance=np.diag(np.full(9, 1e-6)), noise=Noise(1.0),
        reference=Reference(5e4),
    )  # fmt: skip
    return pose(survey, calibration)


@pytest.fixture(scope="session")
def right() -> Callable[[int], Problem]:
    """``right(rows)``: a vehicle that is right but for noise."""
    return _right


def _thinned(survey: Survey, here: np.ndarray) -> Survey:
    """Return what is left of a survey of even steps when samples are lost."""
    rows = {name: getattr(survey, name)[here] for name in ("time", "field", "reference", "dive", "learned")}
    channels = {name: c._replace(values=c.values[here]) for name, c in survey.channels.items()}
    steps = np.append(FAR, np.minimum(np.diff(np.flatnonzero(here)), FAR))
    return replace(survey, **rows, channels=channels, steps=steps)


@pytest.fixture(scope="session")
def thinned() -> Callable[[Survey, np.ndarray], Survey]:
    """``thinned(survey, here)``: what is left of a survey of even steps when samples are lost."""
    return _thinned
