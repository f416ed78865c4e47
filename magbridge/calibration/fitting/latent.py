"""What a joint fit finds beside the coefficients: level, slow changes with time, offsets, a bent track.

Each is a few functions of time with a Gaussian prior whose width the evidence chooses, and enters the fit as
further unknowns behind the coefficients' own. Of those that are offered only such stay that make the log
likelier: on a track that never crosses itself what changes slowly with time is as likely as rock, and its
width may be any.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.evidence import Quadratic, maximise
from magbridge.calibration.fitting.prior import PriorFamily

__all__ = ["NOTHING", "Group", "Offset", "likeliest", "slow_functions", "with_groups"]

APART = 3.0 * 3600.0
"""s without a sample, after which what changes slowly starts anew."""
FASTEST = 1.5 * 3600.0
"""s, half the period of the fastest slow change."""
MOST = 60
"""Slow functions of one stretch of a log, at most."""
LIKELIER = 6.0
"""Nats that what is offered must gain (400:1: the best of several lags gains 3 where there is nothing)."""
NOTHING = PriorFamily(
    np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros(0), np.zeros(0), ()
)
"""A prior of no coefficients."""


@dataclass(frozen=True, eq=False)
class Group:
    """Unknowns of one kind that share a width.

    Attributes
    ----------
    name : str
    functions : (n, r) array
        What they add to the reference at every sample, nT a unit.
    shape : (r,) array
        Width of each over the group's.
    width, spread : float
        The group's width, in the unknowns' unit, and the 1-sigma of its logarithm; 0: it is given.
    offered : bool
        Whether it stays only where the log needs it.
    """

    name: str
    functions: FloatArray
    shape: FloatArray
    width: float
    spread: float = 0.0
    offered: bool = False


@dataclass(frozen=True, eq=False)
class Offset(Group):
    """Unknowns that add to the sensor's offset along each axis, and not to the reference.

    `functions` are (n, r), the unknowns (3 r,), axis by axis. With a temperature `lag` is that through which
    it acts, s; None: the offset creeps with time.
    """

    lag: float | None = None


def slow_functions(time: FloatArray, fastest: float = FASTEST) -> tuple[FloatArray, FloatArray]:
    """Return functions of time that change slowly (n, r), and their widths (r,) as those of a random walk.

    Notes
    -----
    A random walk over a time T is the sum of ``sqrt(2) cos(pi k t/T)`` with independent weights that fall
    as 1/k (Karhunen-Loeve), beside where it starts. After a gap of :data:`APART` it starts anew.
    """
    stretch = stretches(time)
    many = int(stretch[-1]) + 1
    columns, widths = [], []
    for k in range(many):
        mine = stretch == k
        t = time[mine] - time[mine][0]
        span = max(float(t[-1]), 1e-9)
        count = min(int(span / fastest), MOST)
        waves = np.zeros((len(time), count + (many > 1)))
        order = np.arange(1, count + 1)
        waves[mine, :count] = np.sqrt(2.0) * np.cos(np.pi * order * t[:, None] / span)
        shape = 1.0 / order
        if many > 1:  # against the other stretches, its level
            waves[mine, -1] = 1.0
            shape = np.append(shape, 1.0)
        columns.append(waves)
        widths.append(shape)
    return np.concatenate(columns, axis=1), np.concatenate(widths)


def stretches(time: FloatArray) -> IndexArray:
    """Return the number of the stretch without a gap that each sample (n,) belongs to."""
    return np.cumsum(np.diff(time, prepend=time[:1]) > APART)


def with_groups(family: PriorFamily, groups: tuple[Group, ...]) -> PriorFamily:
    """Return a family of priors with the groups' unknowns behind its own; they move no coefficient."""
    q, h = family.design.shape
    many = sum(len(group.shape) for group in groups)
    free = [group for group in groups if group.spread]
    design = np.zeros((q + many, h + len(free)))
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
        return with_groups(family.renew(z[:q]), groups)

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


def likeliest(
    quadratic: Quadratic,
    own: PriorFamily,
    groups: tuple[Group, ...],
    eta: FloatArray,
    sigma: float,
) -> tuple[Group, ...]:
    """Return the groups without those that are offered and that the log does not need; one lag at most.

    Parameters
    ----------
    quadratic : Quadratic
        In the unknowns of all groups, behind those of `own`.
    own : PriorFamily
        Of the coefficients.
    groups : tuple of Group
        All that are in the fit.
    eta, sigma : (h,) array, float
        Widths and noise (nT), from which to climb.
    """
    first, free = _starts(own, groups)

    def score(kept: tuple[Group, ...]) -> float:
        rows = [np.arange(own.E.shape[1])]
        rows += [first[one.name] + np.arange(len(one.shape)) for one in kept]
        i = np.concatenate(rows)
        part = Quadratic(quadratic.H[np.ix_(i, i)], quadratic.b[i], quadratic.c_0, quadratic.n)
        widths = [*range(len(own.centre)), *(free[one.name] for one in kept if one.spread)]
        terms = sum(one.offered for one in kept)
        return maximise(part, with_groups(own, kept), eta[widths], sigma).log_evidence - LIKELIER * terms

    return max(_choices(groups), key=score)


def _choices(groups: tuple[Group, ...]) -> Iterator[tuple[Group, ...]]:
    """Yield all choices: none first, so that it is taken where nothing is likelier."""
    lags = [one for one in groups if isinstance(one, Offset) and one.lag is not None]
    others = [one for one in groups if one.offered and one not in lags]
    for chosen in product([None, *lags], *([None, one] for one in others)):
        yield tuple(one for one in groups if not one.offered or one in chosen)


def _starts(own: PriorFamily, groups: tuple[Group, ...]) -> tuple[dict[str, int], dict[str, int]]:
    """Return where the unknowns of each group begin, and where its width stands."""
    first, free, row, column = {}, {}, own.E.shape[1], len(own.centre)
    for one in groups:
        first[one.name], free[one.name] = row, column
        row, column = row + len(one.shape), column + bool(one.spread)
    return first, free
