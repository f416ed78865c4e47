"""Where a joint fit to a survey stands, and where it starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.field_doubt import plausible
from magbridge.calibration.fitting.field_search import Choice, Weighed
from magbridge.calibration.fitting.nominal import starts
from magbridge.calibration.fitting.survey_samples import SurveySamples
from magbridge.estimation.elimination import FieldEliminated, SampleSums, eliminate_field
from magbridge.estimation.hyperparameters import Hyperparameters
from magbridge.estimation.information import covariance_of
from magbridge.estimation.noise import NoiseModel
from magbridge.estimation.optimise import gauss_newton
from magbridge.estimation.priors import PriorFamily
from magbridge.estimation.residual import residuals_of, robust_scale

__all__ = ["Answer", "start"]


@dataclass(frozen=True, eq=False)
class Answer:
    """Where the rounds stand; `lacking` (n,) nT is what they add to the reference at every sample."""

    z: FloatArray
    w: FloatArray
    sums: SampleSums
    choice: Choice
    widths: Hyperparameters
    family: PriorFamily
    lacking: FloatArray
    score: float
    middle: float
    """m, the length that was expected."""

    def covariance(self) -> FloatArray:
        """Return that of z (q, q), with what the data leave open of the field's size and length."""
        s2 = self.widths.sigma**2
        precision = self.family.at(self.widths.eta).precision
        weighed = Weighed(self.family, self.widths.eta, self.widths.sigma, self.middle)

        def reduced(one: Choice) -> FieldEliminated:
            return eliminate_field(self.sums, one.field, one.ratio, one.rho)

        total = np.zeros_like(precision)
        for weight, one in plausible(
            lambda one: weighed.score(reduced(one), one.field, one.ratio), self.choice
        ):
            quadratic = reduced(one).quadratic
            P = covariance_of(quadratic.precision / s2 + precision)
            moved = P @ quadratic.vector / s2 - self.z
            total += weight * (P + np.outer(moved, moved))
        return total


def start(survey: SurveySamples, family: PriorFamily) -> tuple[FloatArray, float]:
    """Return z (q,) near the answer, the rock taken for noise; and the size of that."""
    samples, prior = survey.samples, family.at(family.centre)
    found: list[tuple[float, FloatArray]] = []
    for one in starts(samples):
        z = family.near(one)
        sigma = np.inf
        for _ in range(5):
            e = residuals_of(samples, prior.coefficients(z))
            sigma = max(robust_scale(e), 1.0)
            z = gauss_newton(samples, prior, NoiseModel(sigma), z, steps=8).z
        found.append((sigma, z))
    sigma, z = min(found, key=lambda one: one[0])
    return z, sigma
