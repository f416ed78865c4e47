"""Unknowns of a joint fit in addition to the coefficients: level, slow changes, offsets, position drift.

Each is a few functions of time with a Gaussian prior whose width the evidence chooses, and enters the fit as
further unknowns behind the coefficients' own. Optional terms stay only if they make the log likelier: on a
track that never crosses itself a slow change with time is as likely as a crustal anomaly, and its width may
be any.
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
"""Slow functions of one stretch of a log, at most."""
BLOCK_ROWS = 16_384
"""Rows at a time."""
NO_COEFFICIENTS = PriorFamily(
    np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros(0), np.zeros(0), ()
)
"""A prior of no coefficients."""


@dataclass(frozen=True, eq=False)
class ParameterBlock:
    """Unknowns of one kind that share a width."""

    name: str
    functions: FloatArray | SlowFunctions
    """(n, r): What they add to the reference at every sample, nT a unit."""
    shape: FloatArray
    """(r,): Width of each over the group's."""
    width: float
    spread: float = 0.0
    """`width`, `spread`: The group's width, in the unknowns' unit, and the 1-sigma of its logarithm; 0: it is
    given."""
    offered: bool = False
    """True for an optional term, which stays only if the log needs it."""


@dataclass(frozen=True, eq=False)
class OffsetBlock(ParameterBlock):
    """Unknowns that add to the sensor's offset along each axis, and not to the reference.

    `functions` are (n, r), the unknowns (3 r,), axis by axis. With a temperature `lag` is that through which
    it acts, s; None: the offset creeps with time.
    """

    lag: float | None = None


class SlowFunctions:
    """Functions of time that change slowly, as an array (n, r); computed for the rows that are indexed.

    `time` (n,): s. `fastest`: half the period of the fastest function, s.

    Notes
    -----
    A random walk over a time T is the sum of ``sqrt(2) cos(pi k t/T)`` with independent weights that fall
    as 1/k (Karhunen-Loeve), and of its start. After a gap of :data:`MAX_PAUSE_S` it restarts.
    """

    def __init__(self, time: FloatArray, fastest: float = SHORTEST_CHANGE_HALF_PERIOD_S) -> None:
        self.time, self.stretch = time, np.cumsum(np.diff(time, prepend=time[:1]) > MAX_PAUSE_S)
        _, first, size = np.unique(self.stretch, return_index=True, return_counts=True)
        self.start = time[first]
        self.span = np.maximum(time[first + size - 1] - self.start, 1e-9)
        # as many half waves as the stretch has periods of the fastest change
        self.count = np.minimum(self.span / fastest, MAX_SLOW_FUNCTIONS).astype(int)
        self.levels = len(first) > 1
        """True if each has a level against the others, too."""
        self.edges = np.cumsum([0, *(self.count + self.levels)])

    @property
    def shape(self) -> FloatArray:
        """The functions' widths (r,)."""
        # weights of a random walk fall as 1/k
        level = [1.0] * self.levels
        return np.concatenate([[*(1.0 / np.arange(1, count + 1)), *level] for count in self.count])

    def __getitem__(self, rows: IndexArray | slice) -> FloatArray:
        t, of = self.time[rows], self.stretch[rows]
        out = np.zeros((len(t), int(self.edges[-1])))
        for k in np.unique(of).tolist():
            mine, order = of == k, np.arange(1, self.count[k] + 1)
            # Half waves of each stretch (Karhunen-Loeve of a random walk), and its level against the others.
            phase = np.pi * (t[mine] - self.start[k])[:, None] / self.span[k]
            columns = [np.sqrt(2.0) * np.cos(order * phase), np.ones_like(phase)[:, : int(self.levels)]]
            out[mine, self.edges[k] : self.edges[k + 1]] = np.hstack(columns)
        return out

    def __matmul__(self, weights: FloatArray) -> FloatArray:
        return in_chunks(len(self.time), lambda rows: self[rows] @ weights)


class BlockColumns:
    """The functions of several groups side by side, (n, p) as an array."""

    def __init__(self, groups: Sequence[ParameterBlock]) -> None:
        self.parts = [group.functions for group in groups]
        self.edges = np.cumsum([0, *(part[:1].size for part in self.parts)])

    def __len__(self) -> int:
        """How many columns there are."""
        return int(self.edges[-1])

    def __getitem__(self, rows: IndexArray | slice) -> FloatArray:
        return np.concatenate([part[rows] for part in self.parts], axis=1)

    def __matmul__(self, weights: FloatArray) -> FloatArray:
        # product column by column: the columns of slow functions are never all in memory
        pieces = zip(self.parts, np.split(weights, self.edges[1:-1]), strict=True)
        return np.asarray(sum(part @ mine for part, mine in pieces))


def in_chunks(n: int, made: Callable[[slice], FloatArray]) -> FloatArray:
    """Return the result (n, ...) of `made` for n rows, computed in chunks of bounded memory."""
    return np.concatenate(
        [made(slice(start, start + BLOCK_ROWS)) for start in range(0, max(n, 1), BLOCK_ROWS)]
    )


def with_blocks(family: PriorFamily, groups: tuple[ParameterBlock, ...]) -> PriorFamily:
    """Return a family of priors with the groups' unknowns behind its own; they move no coefficient."""
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
