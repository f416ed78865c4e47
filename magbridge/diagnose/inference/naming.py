r"""The chance that a cause, if present, would be named alone.

It depends on telemetry, attitude and noise, not on the residual.

Notes
-----
With the information S of all candidates, a cause j whose coefficients b have the signal-to-noise
``a^2 = b^T S_jj b`` gives a competing hypothesis i the likelihood ratio ``R_i = s^T S_ii^-1 s``,
``s = S_ij b``: the part that it can imitate. The difference of the two ratios is normal about
``a^2 - R_i = delta^2`` with standard deviation ``2 delta`` (two subspaces in Gaussian noise), so the log
evidence by which the truth wins has the standard deviation delta, and the chance that it exceeds
:func:`~.evidence.bayes_factor_threshold` is a normal integral. Competing hypotheses are taken as independent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2, ncx2, norm

from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.inference.evidence import LEVEL, bayes_factor_threshold, log_bayes
from magbridge.diagnose.inference.hypothesis import Hypothesis
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.statistic import Statistic

__all__ = ["chances_alone"]


def chances_alone(
    candidates: Sequence[Candidate],
    info: Information,
    named: Sequence[Hypothesis],
    look_elsewhere: Mapping[str, float],
    causes: int,
) -> list[float]:
    """Return the chance of each cause, of this size and direction, to be named alone in such a log.

    Parameters
    ----------
    candidates : sequence of Candidate
        All that were searched.
    info : Information
        Of their columns and, last, of those that are named.
    named : sequence of Hypothesis
        The causes in question.
    look_elsewhere : mapping
        Cause -> number of independent hypotheses behind it.
    causes : int
        Number of causes in the table.
    """
    S, places = info.matrix, slices([*candidates, *(h.candidate for h in named)])
    others = [
        (candidate, at, Statistic(S[at, at], candidate.spectra))
        for candidate, at in zip(candidates if named else (), places, strict=False)
    ]
    found = []
    for hypothesis, own in zip(named, places[len(candidates) :], strict=True):
        b, a2 = hypothesis.fit.coefficients[-hypothesis.candidate.size :], hypothesis.signal_to_noise**2
        s = S[:, own] @ b * np.sqrt(a2 / max(float(b @ S[own, own] @ b), 1e-300))
        freedom = hypothesis.candidate.freedom
        truth = log_bayes(a2 + freedom, freedom)
        chances: dict[str, float] = {}
        for other, at, statistic in others:
            free, part = int(statistic.freedom), s[at]
            if other.cause == hypothesis.candidate.cause or not free or (other.positive and part.min() < 0.0):
                continue
            ratio = float(statistic.ratio(part[:, None])[0])
            delta = max(np.sqrt(max(a2 - ratio, 0.0)), 1e-3)
            wins = float(
                norm.cdf((truth - log_bayes(ratio + free, free) - bayes_factor_threshold(a2)) / delta)
            )
            limit = chi2.isf(LEVEL / (other.tail * look_elsewhere.get(other.cause, 1.0) * causes), free)
            detected = float(ncx2.sf(limit, free, max(ratio, 1e-9)))
            chances[other.cause] = min(chances.get(other.cause, 1.0), 1.0 - (1.0 - wins) * detected)
        found.append(float(np.prod(list(chances.values()))) if a2 > 0.0 else 0.0)
    return found
