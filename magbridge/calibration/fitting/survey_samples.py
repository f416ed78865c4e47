"""The samples of a survey, and their residuals linearised about any answer of a joint fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.calibration.fitting.level import sizes
from magbridge.calibration.fitting.observations import Observations
from magbridge.config import Align
from magbridge.estimation.blocks import (
    BLOCK_ROWS,
    BlockColumns,
    OffsetBlock,
    ParameterBlock,
    SlowFunctions,
    in_chunks,
)
from magbridge.estimation.elimination import LinearisedRows
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.priors import PriorFamily
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals

__all__ = ["Drift", "SurveySamples", "beside_motion"]


class Drift(NamedTuple):
    """How positions drift with time: functions (n, r), their widths (r,) over `sigma`, and that, m."""

    waves: FloatArray | SlowFunctions
    shape: FloatArray
    sigma: float


def beside_motion(time: FloatArray, values: FloatArray, spans: FloatArray) -> BoolArray:
    """Return True for samples (n,) next to a motion of a mass, as defined in :mod:`magbridge.track`.

    When a mass begins to move after its last report, no telemetry gives its position.

    `time` (n,): s. `values` (n, k): positions of the masses. `spans` (k,): range of each mass.
    """
    # a step of a position by more than its slowest motion allows means that the mass moves
    fastest = Align().moving_rate * spans * np.maximum(np.diff(time), 1.0)[:, None]
    step = (np.abs(np.diff(values, axis=0)) > fastest).any(axis=1)
    moving = np.zeros(len(time), bool)
    moving[1:] |= step
    moving[:-1] |= step
    return moving


def _at_rest(data: Observations) -> BoolArray:
    """Return True for samples (n,) without a motion of a mass; all True if most move, as with a current."""
    span = np.ptp(data.parameters, axis=0) if len(data) else np.zeros(len(data.names))
    rest = ~beside_motion(data.time, data.parameters, span)
    return rest if rest.mean() > 0.5 else np.ones(len(data), bool)


class SurveySamples:
    """The data of a joint fit, and their linearisation about any answer.

    `data`: with places; where `unmapped` is 0 the reference is the true field. `samples`: the samples, with
    the monomials of the positions. `groups`: unknowns in addition to the coefficients. `drift`: how
    positions may be off: further unknowns, which act through the field's slope.
    """

    def __init__(
        self,
        data: Observations,
        samples: ResidualSamples,
        groups: tuple[ParameterBlock, ...],
        drift: Drift | None = None,
    ) -> None:
        assert data.place is not None
        assert data.unmapped is not None
        self.samples, self.drift = samples, drift
        self.unmapped = data.unmapped
        self.place = self.as_logged = data.place[:, :2]
        self.middle = float(np.nanmedian(data.place[:, 2]))
        self.deeper = np.nan_to_num(data.place[:, 2] - self.middle)
        self.at_rest = _at_rest(data)
        self.kept = self.at_rest.copy()
        if drift is not None:
            nothing = np.zeros((len(samples.field), 0))
            groups = (
                *groups,
                *(ParameterBlock(f"position {way}", nothing, drift.shape, drift.sigma) for way in ("n", "e")),
            )  # fmt: skip
        self.keep(groups)

    def thinned(self, step: int) -> SurveySamples:
        """Return every `step`-th sample."""
        few, rows = copy(self), np.arange(0, len(self.kept), step)
        for name in ("unmapped", "place", "as_logged", "deeper", "at_rest", "kept"):
            setattr(few, name, getattr(self, name)[rows])
        # intervals are counted in units of `step`, so that the noise has one autocorrelation per row
        few.samples = replace(self.samples.part(rows), steps=np.append(np.inf, self._intervals(rows)) / step)
        if self.drift is not None:
            few.drift = self.drift._replace(waves=self.drift.waves[rows])
        few.keep(tuple(replace(group, functions=group.functions[rows]) for group in self.groups))
        return few

    def keep(self, groups: tuple[ParameterBlock, ...]) -> None:
        """Continue with these groups of unknowns: those of the reference first, then offsets."""
        self.groups = groups
        self.offsets = [group for group in groups if isinstance(group, OffsetBlock)]
        self.steady = BlockColumns([group for group in groups if not isinstance(group, OffsetBlock)])
        self.bent = len(self.steady) + sum(len(group.shape) for group in self.offsets)
        """Where the unknowns of the positions begin."""
        many = 0 if self.drift is None else len(self.drift.shape)
        # columns: reference blocks, offset blocks (x, y, z of each), drift north, drift east
        self.slopes = np.zeros((len(self.kept), 2 * many))

    def slow(self, latent: FloatArray) -> FloatArray:
        """Return the missing part of the reference except the crustal field (n,), nT: level, slow changes."""
        return (self.steady @ latent[: len(self.steady)]) * self.unmapped

    def offset(self, latent: FloatArray, blocks: Sequence[OffsetBlock] | None = None) -> FloatArray:
        """Return the sensor's offset (n, 3), nT, without its dependence on the positions.

        `latent` (p,) are the unknowns of all groups; `blocks` are the offsets that count, by default all.
        """
        # an offset block has its functions on each axis in turn: d = (x..., y..., z...)
        out, start = np.zeros((len(self.kept), 3)), len(self.steady)
        for group in self.offsets:
            d = latent[start : start + len(group.shape)]
            start += len(d)
            if blocks is None or group in blocks:
                out += group.functions @ d.reshape(3, -1).T
        return out

    def basis(self, field: GaussianField, rows: IndexArray | slice) -> csr_array:
        """Return the contribution of the field's coefficients to the reference at `rows`, (m, nodes)."""
        known = field.basis(self.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.unmapped[rows]) @ known)

    def rock(self, field: GaussianField, w: FloatArray) -> FloatArray:
        """Return the field of coefficients w (nodes,) or (nodes, k) at every sample, (n,) or (n, k), nT."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w)

    def bend(self, field: GaussianField, w: FloatArray, latent: FloatArray) -> None:
        """Move the track by the unknowns `latent` (p,), and use the field's slope there.

        `w` (nodes,) are the field's coefficients, nT.
        """
        if self.drift is None:
            return
        # f(x + dx) = f(x) + grad f . dx, dx = waves @ (north, east): the slope is taken at the new place
        north, east = latent[self.bent :].reshape(2, -1)
        waves = self.drift.waves[:]
        self.place = self.as_logged + np.stack([waves @ north, waves @ east], axis=1)
        slopes = [(slope @ w * self.unmapped)[:, None] * waves for slope in field.slopes(self.place)]
        self.slopes = np.hstack(slopes)

    def linear(
        self,
        family: PriorFamily,
        z: FloatArray,
        field: GaussianField,
        w: FloatArray,
        rows: IndexArray,
        step: int = 1,
    ) -> Iterator[LinearisedRows]:
        """Yield `rows` (m,), every `step`-th sample, linearised about z (q,) and w (nodes,)."""
        # One row of the linearised residual: e(z, w) = e_0 + D (z - z_0) + B (w - w_0). D holds the
        # derivatives by coefficients, reference blocks, offsets and drift; everything is over s, the size
        # of a sensor nT.
        latent = z[family.E.shape[1] - sum(len(group.shape) for group in self.groups) :]
        slow, offset = self.slow(latent), self.offset(latent)
        follows = np.zeros(len(rows), bool)
        follows[1:] = self._intervals(rows) == step
        c = family.E @ z + family.offset
        E = family.E[:, : len(z) - len(latent)]
        for start in range(0, len(rows), BLOCK_ROWS):
            # one row of overlap: whitening needs the previous row of the last block
            part = slice(max(start - 1, 0), start + BLOCK_ROWS)
            mine = rows[part]
            B, samples = self.basis(field, mine), self.samples.part(mine)
            piece = replace(
                samples, reference=samples.reference + slow[mine] + B @ w, field=samples.field - offset[mine]
            )
            e, g = residuals(piece, c)
            size = sizes(piece, c)
            # a higher reference lowers the residual: -1/s
            steady = self.steady[mine] * (-self.unmapped[mine] / size)[:, None]
            # an offset acts as T does: columns 6 to 8 of the derivative by the nine numbers
            offsets = [g[:, 6 + k, None] * one.functions[mine] for one in self.offsets for k in range(3)]
            slopes = -self.slopes[mine] / size[:, None]
            D = np.hstack([jacobian(piece.phi, g) @ E, steady, *offsets, slopes])
            here = csr_array(diags_array(-1.0 / size) @ B)
            yield LinearisedRows(
                np.column_stack([e - D @ z - here @ w, D]), here, follows[part], overlap=start > 0
            )

    def _intervals(self, rows: IndexArray) -> FloatArray:
        """Return sampling intervals between successive `rows`; infinite across runs."""
        # a run begins 1e9 intervals after the last: no correlation is left
        steps = np.where(np.isfinite(self.samples.steps), self.samples.steps, 1e9)
        steps[0] = 0.0
        return np.diff(np.cumsum(steps)[rows])
