"""The field of a gridded survey, at any place: its mean and sigma over all that the data leave open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import BoolArray, FloatArray
from magbridge.estimation.blocks import in_chunks
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.hyperparameters import Hyperparameters
from magbridge.estimation.sparse import InverseBlocks, SparseFactor
from magbridge.survey.kriged import Kriged
from magbridge.survey.roughness import Roughness
from magbridge.survey.samples import Samples

__all__ = ["Gridded", "Posterior"]


@dataclass(frozen=True, eq=False)
class Posterior:
    """The field given its size and length."""

    weight: float
    """How plausible these are."""
    field: GaussianField
    size: float
    sigma: float
    """`size`, `sigma`: nT, the field's standard deviation where the roughness is 1, and the noise's."""
    w: FloatArray
    """(nodes,): The field's coefficients."""
    follow: FloatArray
    """(nodes, r): Change of the nodes with 1-sigma of each other uncertainty: levels, slow changes, the
    calibration."""
    precision: csr_array
    """(nodes, nodes), in units of the noise's."""
    inverse: InverseBlocks
    """Of it."""
    levels: FloatArray
    """(n,), nT, subtracted from each sample: its line's level and the slow part, about their mean."""
    mean: float
    """Mean of the field over the samples, nT: a level, which no survey determines and the sigma excludes."""

    def evaluate(self, B: csr_array) -> tuple[FloatArray, FloatArray]:
        """Return the field and its variance, (n,) each, of splines B (n, nodes)."""
        return B @ self.w, self.sigma**2 * self.inverse.variances(B) + ((B @ self.follow) ** 2).sum(axis=1)

    def draw(self, rng: np.random.Generator, number: int) -> FloatArray:
        """Draw `number` sets of coefficients (nodes, number) from the posterior."""
        # Random field by its precision, and the other uncertainties by their modes.
        off = self.sigma * SparseFactor(self.precision).draw(rng.normal(size=(len(self.w), number)))
        return np.asarray(
            self.w[:, None] + off + self.follow @ rng.normal(size=(self.follow.shape[1], number))
        )


@dataclass(frozen=True, eq=False)
class Gridded:
    """A gridded survey: ask it for the field at any place."""

    posteriors: tuple[Posterior, ...]
    """Posterior of the likeliest size and length first, then further ones that the data allow."""
    roughness: Roughness
    """How the field's size varies from place to place."""
    rho: float
    """The noise's autocorrelation."""
    middle: float
    """Depth at which the map holds, m."""
    mean: float
    """Mean of all samples, and of the map over them, nT."""
    kept: BoolArray
    """(n,): True for samples that are not outliers."""
    widths: Hyperparameters
    """As the evidence chose them."""
    kriged: Kriged | None = None
    """Predictor to use instead of the nodes if these are coarser than the crustal field."""

    @property
    def field(self) -> GaussianField:
        """The likeliest field."""
        return self.posteriors[0].field

    @property
    def size(self) -> float:
        """The field's standard deviation where the roughness is 1, nT."""
        return float(np.sqrt(sum(one.weight * one.size**2 for one in self.posteriors)))

    @property
    def sigma(self) -> float:
        """The noise's, nT."""
        return self.posteriors[0].sigma if self.kriged is None else self.kriged.noise

    @property
    def levels(self) -> FloatArray:
        """(n,), nT, subtracted from each sample: its line's level and the slow part."""
        return np.asarray(sum(one.weight * one.levels for one in self.posteriors))

    def evaluate(
        self, place: FloatArray, depth: FloatArray | float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the anomaly and its 1-sigma (n,) each, nT, at places (n, 2), m, and depths (n,), m.

        The depth is the map's own if not given; where the samples are kriged it is that of those around.
        """
        if self.kriged is not None:
            return self._beside_samples(place)
        # Mixture over the plausible sizes and lengths: mean, and second moment for the variance.
        deeper = 0.0 if depth is None else np.asarray(depth, float) - self.middle
        scale = self.roughness.evaluate(place)
        outside = ~self.field.nodes.covers(place)
        mean, square = np.zeros(len(place)), np.zeros(len(place))
        for one in self.posteriors:
            here, variance = one.evaluate(csr_array(diags_array(scale) @ one.field.basis(place, deeper)))
            # Beyond the nodes the prior is all that is known.
            variance[outside] = (one.size * scale[outside]) ** 2
            here = here - one.mean
            mean += one.weight * here
            square += one.weight * (variance + here**2)
        return self.mean + mean, np.sqrt(np.maximum(square - mean**2, 0.0))

    def _beside_samples(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the same from the nearest samples; what levels and calibration do to it is the nodes'."""
        assert self.kriged is not None
        # Kriging gives field and noise; levels and calibration enter by the coarse nodes.
        mean, variance = self.kriged.evaluate(place)
        B = csr_array(diags_array(self.roughness.evaluate(place)) @ self.field.basis(place))
        return mean, np.sqrt(variance + ((B @ self.posteriors[0].follow) ** 2).sum(axis=1))

    def draw(self, place: FloatArray, number: int) -> Iterator[FloatArray]:
        """Yield about `number` equally probable anomalies (n,), nT, at places (n, 2), m."""
        rng, rough = np.random.default_rng(0), self.roughness.evaluate(place)
        for one in self.posteriors:
            B = one.field.basis(place)
            for w in one.draw(rng, round(one.weight * number)).T:
                yield self.mean - one.mean + rough * (B @ w)

    def at_samples(self, samples: Samples) -> FloatArray:
        """Return the anomaly (n,), nT, at the samples' own places and depths."""
        # Chunks bound the memory of the splines.
        deeper, rough = np.nan_to_num(samples.depth - self.middle), self.roughness.evaluate(samples.place)

        def evaluate_rows(rows: slice) -> FloatArray:
            parts = [
                one.weight
                * (rough[rows] * (one.field.basis(samples.place[rows], deeper[rows]) @ one.w) - one.mean)
                for one in self.posteriors
            ]
            return np.asarray(self.mean + sum(parts))

        return in_chunks(len(rough), evaluate_rows)
