"""What a joint fit finds beside the coefficients: level, slow changes with time, offsets, a bent track.

Each is a few functions of time with a Gaussian prior whose width the evidence chooses, and enters the fit as
further unknowns behind the coefficients' own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.prior import PriorFamily

__all__ = ["NOTHING", "Group", "Offset", "slow_functions", "with_groups"]

APART = 3.0 * 3600.0
"""s without a sample, after which what changes slowly starts anew."""
FASTEST = 1.5 * 3600.0
"""s, half the period of the fastest slow change."""
MOST = 60
"""Slow functions of one stretch of a log, at most."""
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
    """

    name: str
    functions: FloatArray
    shape: FloatArray
    width: float
    spread: float = 0.0


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
