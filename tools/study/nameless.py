r"""Whether an ideal analyst whose table lacks the cause would be misled by its names.

Notes
-----
He weighs the names of M causes, one or two of them, against N descriptions without a name, at even odds,
as the detector does. Each pays for its choice. With the likelihood ratios R and free numbers k of names m
and log evidence ``E(R, k) = (R - k)/2 - (k/2) ln(R/k)`` (a variance component of k freedoms) something
without a name needs

.. math:: T = \max_m \left(E(R_m, k_m) - c_m\right) - \ln M

c is the price of a name's grid and, of a pair, 20:1 and its choice among the causes.

*unnamed*: at best one of the descriptions has the very shape of the truth, and as many numbers as its cause
would have: ``P(E(R_d, k) - ln N > T)``. No description that could have been anything else does better: a
bound for all analysts. (Of a cause of three numbers at S/N 10, N = 20, it is 95 % where the best name of
three numbers leaves 4.8.)

*described*: the chance with the descriptions that there are, ``P(max_j E_j - ln N > T)``: each has
numbers of one common size, which is the likeliest, and pays for all the shapes that it could have taken,
and for its choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.inference.descriptions import Description
from magbridge.diagnose.inference.evidence import ODDS
from study.draws import Draws, Span, weigh

Array = NDArray[np.float64]


def against(
    draws: Draws, names: Mapping[str, Array], pairs: Sequence[tuple[Span, Span]], trials: Mapping[str, float]
) -> Array:
    """Log evidence T that a nameless thing needs; `names` are priced for their grids, `pairs` are not."""
    found = [*names.values()]
    for first, second in pairs:
        one, other = draws.ratio(first), draws.beside(first).ratio(second)
        grids = sum(np.log(trials.get(span.cause, 1.0)) for span in (first, second))
        ratio = one[0] + other[0]
        found.append(weigh(ratio, one[1] + other[1]) - grids - ODDS - np.log(max(len(trials), 1)))
    return np.asarray(np.max(found, axis=0) - np.log(max(len(trials), 1)))


def nameless(draws: Draws, truth: Array, needed: Array, free: Sequence[Description]) -> dict[str, float]:
    """Chances of the module's notes; the columns of `free` are the first of `draws`."""
    count = sum(len(one.widths) for one in free)
    best, start = np.full(len(needed), -np.inf), 0
    for one in free:
        own = slice(start, start := start + one.widths[0][1].size)
        for _, width in one.widths:
            ratio, _ = draws.ratio(Span("", None, own, spectra=width[None] ** 2))
            best = np.maximum(best, 0.5 * ratio - np.log(one.trials))
    return {
        "unnamed": float(np.mean(truth - np.log(count) > needed)),
        "described": float(np.mean(best - np.log(count) > needed)),
    }
