"""The samples of a survey as rows of a linear model: level and slow changes dense, the field sparse."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.blocks import BLOCK_ROWS, BlockColumns, ParameterBlock, in_chunks
from magbridge.estimation.elimination import LinearisedRows, SampleSums, sum_rows
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.survey.roughness import Roughness
from magbridge.survey.samples import Samples

__all__ = ["Rows"]


class Rows:
    """The samples of a survey as rows of a linear model."""

    def __init__(self, samples: Samples, groups: tuple[ParameterBlock, ...], roughness: Roughness) -> None:
        self.samples, self.groups = samples, groups
        self.mean = float(np.median(samples.value))
        self.middle = float(np.nanmedian(samples.depth))
        self.deeper = np.nan_to_num(samples.depth - self.middle)
        self.D = BlockColumns(groups)
        self.scale = roughness.evaluate(samples.place)
        self.kept = np.ones(len(samples.value), bool)

    def basis(self, field: GaussianField, rows: IndexArray | slice) -> csr_array:
        """Return the contribution of the field's coefficients to the samples `rows`, (m, nodes)."""
        # Splines at the samples, times the roughness there.
        known = field.basis(self.samples.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.scale[rows]) @ known)

    def mean_over_samples(self, field: GaussianField) -> FloatArray:
        """Return the contribution of each of the field's coefficients to the samples' mean, (nodes,)."""
        kept, total = np.flatnonzero(self.kept), np.zeros(field.nodes.size)
        for start in range(0, len(kept), BLOCK_ROWS):
            total += self.basis(field, kept[start : start + BLOCK_ROWS]).sum(axis=0)
        return total / len(kept)

    def rock(self, field: GaussianField, w: FloatArray) -> FloatArray:
        """Return the field of coefficients w (nodes,) at every sample, (n,), nT."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w)

    def sums(self, field: GaussianField, rows: IndexArray, modes: bool = False) -> SampleSums:
        """Return the sums of the samples `rows` (m,), of them the kept; with the calibration's modes."""
        return sum_rows(self._pieces(field, rows, modes))

    def _pieces(self, field: GaussianField, rows: IndexArray, modes: bool) -> Iterator[LinearisedRows]:
        s = self.samples
        rows = rows[self.kept[rows]]
        # Noise is correlated between neighbours on one line only.
        follows = np.zeros(len(rows), bool)
        follows[1:] = (np.diff(rows) == 1) & (s.line[rows][1:] == s.line[rows][:-1])
        for start in range(0, len(rows), BLOCK_ROWS):
            # One row of overlap: the noise is correlated with that of the row before.
            first = max(start - 1, 0)
            mine = rows[first : start + BLOCK_ROWS]
            weight = -1.0 / s.weight[mine]
            V = [(s.value[mine] - self.mean)[:, None], self.D[mine]]
            if modes:
                V.append(s.modes[mine])
            rows_of = np.concatenate(V, axis=1)
            rows_of[:, 1:] *= weight[:, None]
            rows_of[:, 0] *= -weight
            B = csr_array(diags_array(weight) @ self.basis(field, mine))
            yield LinearisedRows(rows_of, B, follows[first : start + BLOCK_ROWS], overlap=start > 0)
