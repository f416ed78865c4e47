"""The samples of a survey as rows of a linear model: level and slow changes dense, the field sparse."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csr_array, diags_array

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.joint import Linear, Sums, add_up
from magbridge.calibration.fitting.latent import CHUNK, Columns, Group, in_chunks
from magbridge.field.place.matern import Matern
from magbridge.survey.roughness import Roughness
from magbridge.survey.samples import Samples

__all__ = ["Rows"]


class Rows:
    """The samples of a survey as rows of a linear model."""

    def __init__(self, samples: Samples, groups: tuple[Group, ...], roughness: Roughness) -> None:
        self.samples, self.groups = samples, groups
        self.mean = float(np.median(samples.value))
        self.middle = float(np.nanmedian(samples.depth))
        self.deeper = np.nan_to_num(samples.depth - self.middle)
        self.D = Columns(groups)
        self.scale = roughness.at(samples.place)
        self.kept = np.ones(len(samples.value), bool)

    def basis(self, field: Matern, rows: IndexArray | slice) -> csr_array:
        """Return what the field's coefficients add to the samples `rows`: (m, nodes)."""
        known = field.basis(self.samples.place[rows], self.deeper[rows])
        return csr_array(diags_array(self.scale[rows]) @ known)

    def mean_over_samples(self, field: Matern) -> FloatArray:
        """Return what each of the field's coefficients adds to the samples' mean: (nodes,)."""
        kept, total = np.flatnonzero(self.kept), np.zeros(field.nodes.size)
        for start in range(0, len(kept), CHUNK):
            total += self.basis(field, kept[start : start + CHUNK]).sum(axis=0)
        return total / len(kept)

    def rock(self, field: Matern, w: FloatArray) -> FloatArray:
        """Return what coefficients w (nodes,) of a field are at every sample: (n,), nT."""
        return in_chunks(len(self.kept), lambda rows: self.basis(field, rows) @ w)

    def sums(self, field: Matern, rows: IndexArray, modes: bool = False) -> Sums:
        """Return the sums of the samples `rows` (m,), of them the kept; with the calibration's modes."""
        return add_up(self._pieces(field, rows, modes))

    def _pieces(self, field: Matern, rows: IndexArray, modes: bool) -> Iterator[Linear]:
        s = self.samples
        rows = rows[self.kept[rows]]
        follows = np.zeros(len(rows), bool)
        follows[1:] = (np.diff(rows) == 1) & (s.line[rows][1:] == s.line[rows][:-1])
        for start in range(0, len(rows), CHUNK):
            first = max(start - 1, 0)
            mine = rows[first : start + CHUNK]
            weight = -1.0 / s.weight[mine]
            V = [(s.value[mine] - self.mean)[:, None], self.D[mine]]
            if modes:
                V.append(s.modes[mine])
            rows_of = np.concatenate(V, axis=1)
            rows_of[:, 1:] *= weight[:, None]
            rows_of[:, 0] *= -weight
            B = csr_array(diags_array(weight) @ self.basis(field, mine))
            yield Linear(rows_of, B, follows[first : start + CHUNK], overlap=start > 0)
