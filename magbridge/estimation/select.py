"""Select parameter blocks by the evidence.

An optional block stays in a fit only if it gains more log evidence than its price. The information about all
unknowns is computed once, with every block in it. Without the rows and columns of a block, it is the
information of a fit without the block (Kass & Raftery 1995, Bayes factors, section 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.estimation.blocks import OffsetBlock, ParameterBlock, with_blocks
from magbridge.estimation.hyperparameters import maximise_evidence
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.priors import PriorFamily

__all__ = ["BLOCK_LOG_EVIDENCE_PRICE", "select_blocks"]

BLOCK_LOG_EVIDENCE_PRICE = 6.0
"""Log evidence that an optional block must gain: odds of 400:1. The best of some lags gains 3 by chance."""


def select_blocks(
    quadratic: GaussianInformation,
    family: PriorFamily,
    groups: tuple[ParameterBlock, ...],
    eta: FloatArray,
    sigma: float,
    price: float = BLOCK_LOG_EVIDENCE_PRICE,
) -> tuple[ParameterBlock, ...]:
    """Return the blocks without optional ones that the log does not need, with one temperature lag at most.

    `quadratic`: information about the unknowns of `family`, then of all blocks. `family`: prior of the
    coefficients. `groups`: all blocks of the fit. `eta` (h,), `sigma`: hyperparameters and noise (nT) at
    which the maximisation starts. `price`: log evidence that each optional block must gain.
    """
    # Exhaustive search: evidence of each choice of blocks, less the price of every offered one.
    first, free = _starts(family, groups)

    def score(kept: tuple[ParameterBlock, ...]) -> float:
        rows = [np.arange(family.E.shape[1])]
        rows += [first[one.name] + np.arange(len(one.shape)) for one in kept]
        i = np.concatenate(rows)
        part = quadratic.part(i)
        widths = [*range(len(family.centre)), *(free[one.name] for one in kept if one.spread)]
        terms = sum(one.offered for one in kept)
        return (
            maximise_evidence(part, with_blocks(family, kept), eta[widths], sigma).log_evidence
            - price * terms
        )

    return max(_choices(groups), key=score)


def _choices(groups: tuple[ParameterBlock, ...]) -> Iterator[tuple[ParameterBlock, ...]]:
    """Yield all choices of blocks; the first is without optional blocks, so it wins if none is likelier."""
    lags = [one for one in groups if isinstance(one, OffsetBlock) and one.lag is not None]
    others = [one for one in groups if one.offered and one not in lags]
    for chosen in product([None, *lags], *([None, one] for one in others)):
        yield tuple(one for one in groups if not one.offered or one in chosen)


def _starts(family: PriorFamily, groups: tuple[ParameterBlock, ...]) -> tuple[dict[str, int], dict[str, int]]:
    """Return the index of the first unknown of each block, and the index of its width in eta."""
    first, free, row, column = {}, {}, family.E.shape[1], len(family.centre)
    for one in groups:
        first[one.name], free[one.name] = row, column
        row, column = row + len(one.shape), column + bool(one.spread)
    return first, free
