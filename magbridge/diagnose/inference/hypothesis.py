"""A cause together with the others of a model: its fit and its evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.evidence import Score
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.joint import Joint, volume_of

__all__ = ["Best", "Hypothesis", "shaped_ratio", "wald_ratio"]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One cause, fitted together with the others of a model."""

    candidate: Candidate
    ratio: float
    """Twice the gain in log likelihood."""
    evidence: float
    """Log Bayes factor against the model without it."""
    p_value: float
    """With the price of the hypotheses behind the cause (look-elsewhere) and of the number of causes."""
    fit: Joint
    """Fit of the whole model; this cause's coefficients are the last."""

    @property
    def signal_to_noise(self) -> float:
        """Whitened norm of the effect, calibration and model projected out, less what noise alone gives."""
        own = slice(-self.candidate.size, None)
        known = self.fit.prior[own] * np.diag(self.fit.covariance)[own]
        power = self.fit.wald(own) - float(np.sum(1.0 - known))
        return float(np.sqrt(power)) if power > 0.0 else 0.0


class Best(NamedTuple):
    """The best candidate of a grid under one noise.

    Its place among all, the price of its nonlinear parameters (log of the grid's average evidence, relative
    to the best), its score, and the information that gave it.
    """

    place: int
    price: float
    score: Score
    info: Information


def shaped_ratio(ratio: float, model: Sequence[Candidate], fit: Joint, *, slow: bool = False) -> float:
    """Likelihood ratio of a model's causes of fixed shape, given its causes of flexible shape.

    `ratio` is the likelihood ratio of the whole model, with `slow` noise if there is any.
    """
    free = np.repeat([one.nonparametric for one in model], [one.size for one in model])
    return min(ratio, fit.wald(np.flatnonzero(~free))) if slow or free.any() else ratio


def wald_ratio(fit: Joint, candidate: Candidate) -> float:
    """Likelihood ratio of the last candidate's coefficients under the noise that is left."""
    own = slice(-candidate.size, None)
    spread = 0.0 if candidate.spectra is None else volume_of(fit.covariance[own, own], fit.prior[own])
    return fit.wald(own) - 2.0 * spread
