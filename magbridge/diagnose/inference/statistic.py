r"""Likelihood ratio of a candidate whose coefficients are each free, or have one common free size.

Notes
-----
With projected information S and score b of k columns in units of their widths, coefficients that are each
free have the likelihood ratio ``R = b^T S^-1 b``, with as many degrees of freedom as the data determine
directions.

A smooth function of the place, or a slow curve, has more coefficients than the data can determine. These have
a Gaussian prior whose variance is a common size g times a spectrum w, the likeliest of each: a Gaussian
process. With ``w^1/2 S w^1/2 = V diag(lambda) V^T``, ``y = V^T w^1/2 b`` the log evidence is

.. math:: E = \max_{g, w} \tfrac12 \sum_i \left(\frac{g y_i^2}{1 + g \lambda_i} - \ln(1 + g \lambda_i)\right)

half the likelihood ratio of a variance component: under no effect ``R = 2 E`` is at most a chi-square of one
degree of freedom (Self & Liang 1987), whatever the number of columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray

__all__ = ["Ridge", "Statistic"]

PRIOR_SIZES = np.logspace(-7, 2, 64)
"""Values of g that are tried, in units of the widths squared."""
VISIBLE = 1e-3
"""Information, as a fraction of the prior's own, below which a direction is ignored."""


@dataclass(frozen=True, eq=False)
class Ridge:
    """The estimate at the likeliest size and spectrum."""

    ratio: float
    estimate: FloatArray
    """(k,)."""
    variance: FloatArray
    """(k,) prior variance of each coefficient."""
    price: float
    """Log evidence that the prior costs: its density at the estimate, and the volume (Occam's factor)."""
    signal_to_noise: float
    """Whitened norm of the estimate."""


class Statistic:
    """The likelihood ratio of one candidate's coefficients.

    Parameters
    ----------
    S : (..., k, k) array
        Of one candidate or, without spectra, of several with as many coefficients.
    spectra : (l, k) array, optional
        Alternatives for the prior variances, up to a common factor; without any, each coefficient is free.
    """

    def __init__(self, S: FloatArray, spectra: FloatArray | None = None) -> None:
        self.spectra = spectra
        if spectra is None:
            values, self.vectors = np.linalg.eigh(S)
            self.values = np.where(values > VISIBLE, values, np.inf)  # ignore directions without a signal
            self.freedom = np.asarray(np.isfinite(self.values).sum(axis=-1))
            return
        root = np.sqrt(spectra)
        values, vectors = np.linalg.eigh(S * root[:, :, None] * root[:, None, :])
        self.values, self.vectors = np.maximum(values, 0.0), root[:, :, None] * vectors
        self.freedom = np.asarray(1)

    def ratio(self, b: FloatArray) -> FloatArray:
        """(..., m) likelihood ratios of scores b (..., k, m)."""
        if self.spectra is None:
            y = np.swapaxes(self.vectors, -1, -2) @ b
            return np.asarray(np.sum(y**2 / self.values[..., None], axis=-2))
        return np.asarray(
            2.0 * np.max([self._evidences(k, b).max(axis=0) for k in range(len(self.spectra))], axis=0)
        )

    def _evidences(self, k: int, b: FloatArray) -> FloatArray:
        """(sizes, m) log evidence with the k-th spectrum."""
        y2, grown = (self.vectors[k].T @ b) ** 2, PRIOR_SIZES[:, None] * self.values[k]
        return np.asarray(
            0.5 * ((PRIOR_SIZES[:, None] / (1.0 + grown)) @ y2 - np.log1p(grown).sum(axis=1)[:, None])
        )

    def best(self, b: FloatArray) -> Ridge:
        """Return the best size and spectrum for a score b (k,)."""
        assert self.spectra is not None
        tables = [self._evidences(k, b[:, None])[:, 0] for k in range(len(self.spectra))]
        k = int(np.argmax([table.max() for table in tables]))
        at = int(np.argmax(tables[k]))
        values, g = self.values[k], PRIOR_SIZES[at]
        c = g * (self.vectors[k].T @ b) / (1.0 + g * values)
        price = 0.5 * float(c @ c / g + np.log1p(g * values).sum())
        ratio, norm = 2.0 * float(tables[k][at]), float(np.sqrt(c**2 @ values))
        return Ridge(ratio, self.vectors[k] @ c, g * self.spectra[k], price, norm)
