"""The interface of a cause, with a numerical check of its derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from inspect import getdoc
from typing import ClassVar

import numpy as np

from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.problem import Problem, samples_of
from magbridge.estimation.residual import residuals_of

__all__ = ["Cause"]

STEP_WIDTHS = 1e-3
"""Change of a coefficient for a numerical derivative, as a fraction of its plausible size."""


class Cause(ABC):
    """A fault that a diagnosis tests; the report prints the first docstring line of each subclass."""

    name: ClassVar[str]
    """Name of the cause in ``findings.json``."""
    meaning: ClassVar[str]
    """Meaning of the cause for a reader of the report, as a clause without its full stop."""
    needs: ClassVar[str]
    """Content that a log needs for a test of the cause, in words."""
    disambiguation: ClassVar[str]
    """Manoeuvre that distinguishes the cause from its competing hypotheses."""
    family: ClassVar[str] = ""
    """Family of the cause, or empty. Causes of one family imitate each other, so they make one finding."""
    delays_telemetry: ClassVar[bool] = False
    """True if the effect is a delay of the telemetry, which ``[telemetry.NAME] delay`` corrects."""

    @abstractmethod
    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a candidate for each point of a grid of nonlinear parameters; none if no test is possible.

        A candidate's widths are plausible sizes of its coefficients (1-sigma of a Gaussian prior).
        """

    @property
    def physics(self) -> str:
        """First line of the class docstring: the physics of the cause, with its equation."""
        return (getdoc(type(self)) or "").splitlines()[0]

    def jacobian_error(self, problem: Problem, candidate: Candidate) -> float:
        """Return the largest error of a candidate's columns, as a fraction of their largest absolute value.

        The columns are compared with numerical derivatives of the residual of the calibration with the
        effect, at :attr:`.Problem.reading`. Return 0 for an error of the reference, and for an effect whose
        regressors the search computes differently from the live correction.
        """
        if not candidate.effects or candidate.regressors is not None or candidate.since:
            return 0.0
        calibration, K = problem.calibration, problem.calibration.coefficients.size
        size = K + candidate.size
        survey = replace(problem.survey, field=problem.reading)
        # Central difference of the nonlinear residual by each coefficient
        columns, worst = candidate.columns(slice(0, len(problem))), 0.0
        for k in range(candidate.size):
            sides = []
            for step in (-STEP_WIDTHS, STEP_WIDTHS):
                coefficients = np.append(calibration.coefficients, np.zeros(candidate.size))
                coefficients[K + k] = step * candidate.width[k]
                extended = replace(
                    calibration, effects=(*calibration.effects, *candidate.effects),
                    coefficients=coefficients, covariance=np.zeros((size, size)),
                )  # fmt: skip
                sides.append(residuals_of(*samples_of(survey, extended)))
            # a coefficient that the calibration lacks adds minus its derivative to the residual
            difference = -(sides[1] - sides[0]) / (2.0 * STEP_WIDTHS)
            worst = max(worst, float(np.abs(difference - columns[:, k]).max()))
        return worst / max(float(np.abs(columns).max()), 1e-300)
