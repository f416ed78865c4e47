r"""Whether an ideal analyst whose table lacks the cause would be misled by its names.

Notes
-----
The analyst weighs the names of M causes, alone and in pairs, against N descriptions without a name, at even
odds, as the detector does. Each pays for having been chosen. With the likelihood ratios R_m and numbers of
coefficients k_m of names m, and the log evidence ``E(R, k) = (R - k)/2 - (k/2) ln(R/k)`` (a variance
component of k degrees of freedom), a description must exceed

.. math:: T = \max_m \left(E(R_m, k_m) - c_m\right) - \ln M

where c is the price of a name's grid and, for a pair, of 20:1 and of its choice among the causes.

*unnamed*: at best one of the descriptions has exactly the true shape, and as many coefficients as its cause
would have: ``P(E(R_d, k) - ln N > T)``. No more general description does better, so this bounds all analysts.
(For a cause of three coefficients at S/N 10 and N = 20 it is 95 % where the best name of three coefficients
leaves an S/N of 4.8.)

*described*: the chance with the detector's descriptions, ``P(max_j E_j - ln N > T)``: the coefficients of
each have one common size, the likeliest, and each pays for all the shapes that it could have taken and for
its choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.diagnose.descriptions import Description
from magbridge.diagnose.evidence import ODDS, log_bayes
from study.draws import Draws, Span


def against(
    draws: Draws,
    names: Mapping[str, FloatArray],
    pairs: Sequence[tuple[Span, Span]],
    look_elsewhere: Mapping[str, float],
) -> FloatArray:
    """Log evidence T that a description must exceed; the price of grids is included in `names` only."""
    found = [*names.values()]
    for first, second in pairs:
        one, other = draws.ratio(first), draws.conditional_on(first).ratio(second)
        grids = sum(np.log(look_elsewhere.get(span.cause, 1.0)) for span in (first, second))
        ratio = one[0] + other[0]
        found.append(log_bayes(ratio, one[1] + other[1]) - grids - ODDS - np.log(max(len(look_elsewhere), 1)))
    return np.asarray(np.max(found, axis=0) - np.log(max(len(look_elsewhere), 1)))


def nameless(
    draws: Draws, truth: FloatArray, needed: FloatArray, free: Sequence[Description]
) -> dict[str, float]:
    """Chances of the module's notes; the columns of `free` are the first of `draws`."""
    count = sum(len(one.widths) for one in free)
    best, start = np.full(len(needed), -np.inf), 0
    for one in free:
        own = slice(start, start := start + one.widths[0][1].size)
        for _, width in one.widths:
            ratio, _ = draws.ratio(Span("", None, own, spectra=width[None] ** 2))
            best = np.maximum(best, 0.5 * ratio - np.log(one.look_elsewhere))
    return {
        "unnamed": float(np.mean(truth - np.log(count) > needed)),
        "described": float(np.mean(best - np.log(count) > needed)),
    }
