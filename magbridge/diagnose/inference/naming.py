r"""The chance that a cause, if present, would be named alone.

It depends on telemetry, attitude and noise, not on the residual.

Notes
-----
With the information S of all candidates, a cause j whose coefficients b have the signal-to-noise
``a^2 = b^T S_jj b`` gives a rival i the likelihood ratio ``R_i = s^T S_ii^-1 s``, ``s = S_ij b``: the part
that the rival can imitate. The difference of the two ratios is normal about ``a^2 - R_i = delta^2`` with
standard deviation ``2 delta`` (two subspaces in Gaussian noise), so the log evidence by which the truth wins
has the standard deviation delta, and the chance that it exceeds :func:`~.evidence.margin` is a normal
integral. Rivals are taken as independent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, ncx2, norm

from magbridge.diagnose.causes.candidates import Candidate, slices
from magbridge.diagnose.inference.evidence import LEVEL, log_bayes, margin
from magbridge.diagnose.inference.information import Information
from magbridge.diagnose.inference.statistic import Statistic

__all__ = ["NamingTheory"]

FloatArray = NDArray[np.float64]


class NamingTheory:
    """The theory of one log: the chance of each cause to be named alone.

    Parameters
    ----------
    candidates : sequence of Candidate
    info : Information
        Of the candidates' columns first; others may follow.
    trials : mapping
        Cause -> number of independent hypotheses behind it.
    causes : int
        Number of causes in the table.
    """

    def __init__(
        self, candidates: Sequence[Candidate], info: Information, trials: Mapping[str, float], causes: int
    ) -> None:
        self.candidates, self.S, self.causes = candidates, info.matrix, causes
        self.at = slices(candidates)
        self.limit: dict[int, float] = {}
        self.freedoms = {c.cause: c.freedom for c in candidates if c.spectra is not None}
        self.statistics = []
        for k, at in enumerate(self.at):
            statistic = Statistic(self.S[at, at], candidates[k].spectra)
            self.statistics.append(statistic)
            tests = candidates[k].tail * trials.get(candidates[k].cause, 1.0) * causes
            self.limit[k] = float(chi2.isf(LEVEL / tests, max(statistic.freedom, 1)))

    def chance(self, cause: str, own: NDArray[np.intp], b: FloatArray, signal_to_noise: float) -> float:
        """Chance that `cause`, with the direction b of the coefficients at `own`, is named alone.

        Parameters
        ----------
        cause : str
            By its public name.
        own : (k,) int array
            Places of the coefficients in the information.
        b : (k,) array
            Only its direction counts.
        signal_to_noise : float
            Of the effect, after projection.
        """
        power = float(b @ self.S[np.ix_(own, own)] @ b)
        if power <= 0.0 or signal_to_noise <= 0.0:
            return 0.0
        s = self.S[:, own] @ b * (signal_to_noise / np.sqrt(power))
        freedom, a2 = self.freedoms.get(cause, len(own)), signal_to_noise**2
        truth = log_bayes(a2 + freedom, freedom)
        chances: dict[str, float] = {}
        for k, candidate in enumerate(self.candidates):
            k_free = self.statistics[k].freedom
            if candidate.cause == cause or not k_free:
                continue
            part = s[self.at[k]]
            if candidate.positive and part.min() < 0.0:
                continue
            ratio = float(self.statistics[k].ratio(part[:, None])[0])
            delta = max(np.sqrt(max(a2 - ratio, 0.0)), 1e-3)
            wins = float(norm.cdf((truth - log_bayes(ratio + k_free, k_free) - margin(a2)) / delta))
            detected = float(ncx2.sf(self.limit[k], k_free, max(ratio, 1e-9)))
            chances[candidate.cause] = min(chances.get(candidate.cause, 1.0), 1.0 - (1.0 - wins) * detected)
        return float(np.prod(list(chances.values())))
