"""The samples of a survey, and their residuals linearised about any answer of a joint fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.joint import Linear
from magbridge.calibration.fitting.latent import Group
from magbridge.calibration.fitting.level import sizes
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.prior import PriorFamily
from magbridge.calibration.residual import Samples, jacobian, residuals
from magbridge.field.place.matern import Matern

__all__ = ["Drift", "SurveySamples"]

CHUNK = 16384
"""Rows at a time: bounded memory at any number of samples."""


class Drift(NamedTuple):
    """How positions drift with time: functions (n, r), their widths (r,) over `sigma`, and that, m."""

    waves: FloatArray
    shape: FloatArray
    sigma: float


class SurveySamples:
    """The data of a joint fit, and their linearisation about any answer.

    Parameters
    ----------
    data : Observations
        With places; where `unmapped` is 0 the reference is the true field.
    samples : Samples
        The same, with the monomials of the positions.
    groups : tuple of Group
        Unknowns beside the coefficients.
    drift : Drift, optional
        How positions may be off: further unknowns, which act through the field's slope.
    """

    def __init__(
        self, data: Observations, samples: Samples, groups: tuple[Group, ...], drift: Drift | None = None
    ) -> None:
        assert data.place is not None
        assert data.unmapped is not None
        self.samples, self.drift = samples, drift
        self.unmapped = data.unmapped
        self.place = self.as_logged = data.place[:, :2]
        self.middle = float(np.nanmedian(data.place[:, 2]))
        self.deeper = np.nan_to_num(data.place[:, 2] - self.middle)
        steady = np.concatenate([group.functions for group in groups], axis=1)
        self.steady = self.functions = steady * self.unmapped[:, None]
        self.groups = groups
        if drift is not None:
            nothing = np.zeros_like(drift.waves)
            self.groups = (
                *groups, *(Group(f"position {way}", nothing, drift.shape, drift.sigma) for way in ("n", "e"))
            )  # fmt: skip
            self.functions = np.hstack([self.steady, nothing, nothing])
        self.kept = np.ones(len(samples.field), bool)

    def basis(self, field: Matern) -> csr_array:
        """Return what the field's coefficients add to the reference (n, nodes)."""
        return csr_array(diags_array(self.unmapped) @ field.basis(self.place, self.deeper))

    def bend(self, field: Matern, w: FloatArray, latent: FloatArray) -> None:
        """Move the track to where it is with the unknowns `latent` (p,), and take the field's slope there.

        `w` (nodes,) are the field's coefficients, nT.
        """
        if self.drift is None:
            return
        r, many = len(self.drift.shape), self.steady.shape[1]
        north, east = latent[many : many + r], latent[many + r :]
        waves = self.drift.waves
        self.place = self.as_logged + np.stack([waves @ north, waves @ east], axis=1)
        slopes = [(slope @ w * self.unmapped)[:, None] * waves for slope in field.nodes.slopes(self.place)]
        self.functions = np.hstack([self.steady, *slopes])

    def linear(
        self,
        family: PriorFamily,
        z: FloatArray,
        lacking: FloatArray,
        w: FloatArray,
        B: csr_array,
        step: int = 1,
    ) -> Iterator[Linear]:
        """Yield every `step`-th sample, linearised about z (q,) and w, as :class:`~.joint.Linear` has them.

        `lacking` (n,), nT, is all that the reference lacks at that answer, B w among it.
        """
        rows = np.flatnonzero(self.kept)[::step]
        samples = self.samples.part(rows)
        samples = replace(samples, reference=samples.reference + lacking[rows])
        follows = np.zeros(len(rows), bool)
        apart = self._apart(rows)
        follows[1:] = apart == step
        c = family.E @ z + family.offset
        many = self.functions.shape[1]
        E = family.E[:, : family.E.shape[1] - many]
        for start in range(0, len(rows), CHUNK):
            first = max(start - 1, 0)
            part = slice(first, start + CHUNK)
            piece = samples.part(part)
            e, g = residuals(piece, c)
            s = sizes(piece, c)
            D = np.hstack([jacobian(piece.phi, g) @ E, -self.functions[rows[part]] / s[:, None]])
            here = csr_array(diags_array(-1.0 / s) @ B[rows[part]])
            y = e - D @ z - here @ w
            yield Linear(np.column_stack([y, D]), here, follows[part], overlap=start > 0)

    def _apart(self, rows: IndexArray) -> FloatArray:
        """Return sampling intervals between successive `rows`; infinite across runs."""
        steps = np.where(np.isfinite(self.samples.steps), self.samples.steps, 1e9)
        steps[0] = 0.0
        return np.diff(np.cumsum(steps)[rows])
