"""Unknowns of a joint fit in addition to the coefficients: bias, slow changes, offsets, position drift.

The unknowns of a block multiply a few functions of time. They follow the unknowns of the coefficients and
have a Gaussian prior, whose width maximises the evidence. An optional block stays only if it increases the
evidence: on a track that never crosses itself, the fit cannot separate a slow change with time from a crustal
anomaly, nor determine the width of either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.estimation.priors import PriorFamily

__all__ = [
    "BLOCK_ROWS", "NO_COEFFICIENTS", "BlockColumns", "OffsetBlock", "ParameterBlock", "SlowFunctions",
    "in_chunks", "with_blocks",
]  # fmt: skip

MAX_PAUSE_S = 3.0 * 3600.0
"""Time without a sample after which slow changes restart, s."""
SHORTEST_CHANGE_HALF_PERIOD_S = 1.5 * 3600.0
"""Half the period of the fastest slow change, s."""
MAX_SLOW_FUNCTIONS = 60
"""Largest number of slow functions in one stretch of a log."""
BLOCK_ROWS = 16_384
"""Number of rows that are computed at a time."""
NO_COEFFICIENTS = PriorFamily(
    np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros(0), np.zeros(0), ()
)
"""Prior of a fit without coefficients."""


@dataclass(frozen=True, eq=False)
class ParameterBlock:
    """Block of unknowns of one kind, whose prior widths have a common factor."""

    name: str
    functions: FloatArray | SlowFunctions
    """(n, r): Change of the reference at every sample per unit of each unknown, nT."""
    shape: FloatArray
    """(r,): Prior width of each unknown divided by the width of the block."""
    width: float
    spread: float = 0.0
    """`width`, `spread`: Prior width of the block, in the unknowns' unit, and 1-sigma of the width's
    logarithm; 0 if the width is fixed."""
    offered: bool = False
    """True for an optional block, which stays only if the log needs it."""


@dataclass(frozen=True, eq=False)
class OffsetBlock(ParameterBlock):
    """Block of unknowns that change the sensor's offset along each axis, and not the reference.

    `functions` are (n, r), the unknowns (3 r,), axis by axis. `lag`: time constant with which the offset
    follows a temperature, s; None for an offset that drifts with time.
    """

    lag: float | None = None


class SlowFunctions:
    """Array (n, r) of functions that change slowly with time, computed only for the rows that are indexed.

    `time` (n,): times of the samples, s. `fastest`: half the period of the fastest function, s. `powers`:
    number of powers of the time in addition.

    Notes
    -----
    A random walk over a time T is a constant plus the sum of ``sqrt(2) cos(pi k t/T)`` with independent
    weights that decrease as 1/k (Karhunen-Loeve). It restarts after a gap of :data:`MAX_PAUSE_S`. The cosines
    have no slope at the ends of a stretch; with the powers t and t², few of them represent a smooth change.
    """

    def __init__(
        self, time: FloatArray, fastest: float = SHORTEST_CHANGE_HALF_PERIOD_S, powers: int = 0
    ) -> None:
        self.time, self.stretch = time, np.cumsum(np.diff(time, prepend=time[:1]) > MAX_PAUSE_S)
        _, first, size = np.unique(self.stretch, return_index=True, return_counts=True)
        self.start = time[first]
        self.span = np.maximum(time[first + size - 1] - self.start, 1e-9)
        # as many half waves as the stretch has half periods of the fastest change
        self.count = np.minimum(self.span / fastest, MAX_SLOW_FUNCTIONS).astype(int)
        self.levels = len(first) > 1
        """True if each stretch also has a constant, relative to the others."""
        self.powers = np.where(self.count > 0, powers, 0)
        self.edges = np.cumsum([0, *(self.count + self.powers + self.levels)])

    @property
    def shape(self) -> FloatArray:
        """Prior widths (r,) of the functions' weights, relative to the first of the longest stretch."""
        # Weights of a random walk over a time T are proportional to sqrt(T) / k.
        level = [1.0] * self.levels
        growth = np.sqrt(self.span / self.span.max())
        sizes = zip(growth, self.count, self.powers, strict=True)
        return np.concatenate([[*(g / np.arange(1, n + 1)), *[g] * m, *level] for g, n, m in sizes])

    def __getitem__(self, rows: IndexArray | slice) -> FloatArray:
        t, of = self.time[rows], self.stretch[rows]
        out = np.zeros((len(t), int(self.edges[-1])))
        for k in np.unique(of).tolist():
            mine, order = of == k, np.arange(1, self.count[k] + 1)
            # Half waves of each stretch (Karhunen-Loeve of a random walk), powers from -1 to 1, and constant.
            phase = np.pi * (t[mine] - self.start[k])[:, None] / self.span[k]
            powers = (2.0 * phase / np.pi - 1.0) ** np.arange(1, self.powers[k] + 1)
            waves, level = np.sqrt(2.0) * np.cos(order * phase), np.ones_like(phase)[:, : int(self.levels)]
            out[mine, self.edges[k] : self.edges[k + 1]] = np.hstack([waves, powers, level])
        return out

    def __matmul__(self, weights: FloatArray) -> FloatArray:
        return in_chunks(len(self.time), lambda rows: self[rows] @ weights)


class BlockColumns:
    """Array (n, p) of the functions of several blocks side by side, computed for the rows indexed."""

    def __init__(self, groups: Sequence[ParameterBlock]) -> None:
        self.parts = [group.functions for group in groups]
        self.edges = np.cumsum([0, *(part[:1].size for part in self.parts)])

    def __len__(self) -> int:
        """Return the number of columns, p."""
        return int(self.edges[-1])

    def __getitem__(self, rows: IndexArray | slice) -> FloatArray:
        return np.concatenate([part[rows] for part in self.parts], axis=1)

    def __matmul__(self, weights: FloatArray) -> FloatArray:
        # product column by column: the columns of slow functions are never all in memory
        pieces = zip(self.parts, np.split(weights, self.edges[1:-1]), strict=True)
        return np.asarray(sum(part @ mine for part, mine in pieces))


def in_chunks(n: int, made: Callable[[slice], FloatArray]) -> FloatArray:
    """Return the values (n, ...) that `made` computes for slices of n rows, in chunks to bound memory."""
    return np.concatenate(
        [made(slice(start, start + BLOCK_ROWS)) for start in range(0, max(n, 1), BLOCK_ROWS)]
    )


def with_blocks(family: PriorFamily, groups: tuple[ParameterBlock, ...]) -> PriorFamily:
    """Return `family` with the unknowns of blocks after its own; these do not change the coefficients."""
    q, h = family.design.shape
    many = sum(len(group.shape) for group in groups)
    free = [group for group in groups if group.spread]
    design = np.zeros((q + many, h + len(free)))
    # Unknowns of the blocks follow those of the family; a block with a free width adds one hyperparameter.
    design[:q, :h] = family.design
    constant = [family.constant]
    row = q
    for group in groups:
        r = len(group.shape)
        fixed = np.log(group.shape)
        if group.spread:
            design[row : row + r, h + [one.name for one in free].index(group.name)] = 1.0
        else:
            fixed = fixed + np.log(group.width)
        constant.append(fixed)
        row += r

    def renew(z: FloatArray) -> PriorFamily:
        assert family.renew is not None
        return with_blocks(family.renew(z[:q]), groups)

    return replace(
        family,
        E=np.hstack([family.E, np.zeros((len(family.E), many))]),
        constant=np.concatenate(constant),
        design=design,
        centre=np.append(family.centre, np.log([group.width for group in free])),
        spread=np.append(family.spread, [group.spread for group in free]),
        names=family.names + tuple(group.name for group in free),
        renew=renew if family.renew is not None else None,
    )
