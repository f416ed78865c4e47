"""The samples of a survey, and their residuals linearised about any answer of a joint fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.joint import Linear
from magbridge.calibration.fitting.latent import Group, Offset
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
        self.kept = np.ones(len(samples.field), bool)
        if drift is not None:
            nothing = np.zeros((len(samples.field), 0))
            groups = (
                *groups, *(Group(f"position {way}", nothing, drift.shape, drift.sigma) for way in ("n", "e"))
            )  # fmt: skip
        self.keep(groups)

    def keep(self, groups: tuple[Group, ...]) -> None:
        """Go on with these groups of unknowns: those that add to the reference come first, then offsets."""
        self.groups = groups
        steady = [group.functions for group in groups if not isinstance(group, Offset)]
        self.steady = np.concatenate(steady, axis=1) * self.unmapped[:, None]
        self.offsets = [group for group in groups if isinstance(group, Offset)]
        self.bent = self.steady.shape[1] + sum(len(group.shape) for group in self.offsets)
        """Where the unknowns of the positions begin."""
        many = 0 if self.drift is None else len(self.drift.shape)
        self.slopes = np.zeros((len(self.kept), 2 * many))

    def offset(self, latent: FloatArray, of: Sequence[Offset] | None = None) -> FloatArray:
        """Return the sensor's offset (n, 3), nT, beside what depends on the positions.

        `latent` (p,) are the unknowns of all groups; `of` are the offsets that count, by default all.
        """
        out, start = np.zeros((len(self.kept), 3)), self.steady.shape[1]
        for group in self.offsets:
            d = latent[start : start + len(group.shape)]
            start += len(d)
            if of is None or group in of:
                out += group.functions @ d.reshape(3, -1).T
        return out

    def basis(self, field: Matern, rows: IndexArray | slice = slice(None)) -> csr_array:
        """Return what the field's coefficients add to the reference, at all samples or `rows`: (m, nodes)."""
        known = field.basis(self.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.unmapped[rows]) @ known)

    def bend(self, field: Matern, w: FloatArray, latent: FloatArray) -> None:
        """Move the track to where it is with the unknowns `latent` (p,), and take the field's slope there.

        `w` (nodes,) are the field's coefficients, nT.
        """
        if self.drift is None:
            return
        north, east = latent[self.bent :].reshape(2, -1)
        waves = self.drift.waves
        self.place = self.as_logged + np.stack([waves @ north, waves @ east], axis=1)
        slopes = [(slope @ w * self.unmapped)[:, None] * waves for slope in field.slopes(self.place)]
        self.slopes = np.hstack(slopes)

    def linear(
        self,
        family: PriorFamily,
        z: FloatArray,
        lacking: FloatArray,
        w: FloatArray,
        B: csr_array,
        rows: IndexArray,
        step: int = 1,
    ) -> Iterator[Linear]:
        """Yield every `step`-th sample, `rows` (m,), linearised about z (q,), w as :class:`~.joint.Linear`.

        `lacking` (m,), nT, is all that the reference lacks there at that answer, B w among it.
        """
        samples = self.samples.part(rows)
        q = family.E.shape[1] - sum(len(group.shape) for group in self.groups)
        samples = replace(
            samples,
            reference=samples.reference + lacking,
            field=samples.field - self.offset(z[q:])[rows],
        )
        follows = np.zeros(len(rows), bool)
        apart = self._apart(rows)
        follows[1:] = apart == step
        c = family.E @ z + family.offset
        E = family.E[:, :q]
        for start in range(0, len(rows), CHUNK):
            first = max(start - 1, 0)
            part = slice(first, start + CHUNK)
            piece = samples.part(part)
            e, g = residuals(piece, c)
            s = sizes(piece, c)
            mine, size = rows[part], s[:, None]
            offsets = [g[:, 6 + k, None] * one.functions[mine] for one in self.offsets for k in range(3)]
            D = np.hstack(
                [jacobian(piece.phi, g) @ E, -self.steady[mine] / size, *offsets, -self.slopes[mine] / size]
            )
            here = csr_array(diags_array(-1.0 / s) @ B[part])
            y = e - D @ z - here @ w
            yield Linear(np.column_stack([y, D]), here, follows[part], overlap=start > 0)

    def _apart(self, rows: IndexArray) -> FloatArray:
        """Return sampling intervals between successive `rows`; infinite across runs."""
        steps = np.where(np.isfinite(self.samples.steps), self.samples.steps, 1e9)
        steps[0] = 0.0
        return np.diff(np.cumsum(steps)[rows])
