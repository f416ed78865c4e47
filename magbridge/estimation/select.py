"""Selection of parameter blocks by the evidence.

Blocks that are optional stay in a fit only if each of them gains more log evidence than its price. The
information about all unknowns is computed once, with every block in it; leaving a block out means to leave
its rows and columns out (Kass & Raftery 1995, Bayes factors, section 3).
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
"""Log evidence that an optional block must gain, 400:1. The best of several lags gains 3 by chance."""


def select_blocks(
    quadratic: GaussianInformation,
    family: PriorFamily,
    groups: tuple[ParameterBlock, ...],
    eta: FloatArray,
    sigma: float,
    price: float = BLOCK_LOG_EVIDENCE_PRICE,
) -> tuple[ParameterBlock, ...]:
    """Return the groups without those that are offered and that the log does not need; one lag at most.

    `quadratic`: in the unknowns of all groups, behind those of `family`. `family`: of the coefficients.
    `groups`: all that are in the fit. `eta`, `sigma` (h,): hyperparameters and noise (nT), from which to
    climb. `price`: nats that each must gain.
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
    """Yield all choices: none first, so that it is taken where nothing is likelier."""
    lags = [one for one in groups if isinstance(one, OffsetBlock) and one.lag is not None]
    others = [one for one in groups if one.offered and one not in lags]
    for chosen in product([None, *lags], *([None, one] for one in others)):
        yield tuple(one for one in groups if not one.offered or one in chosen)


def _starts(family: PriorFamily, groups: tuple[ParameterBlock, ...]) -> tuple[dict[str, int], dict[str, int]]:
    """Return where the unknowns of each group begin, and where its width stands."""
    first, free, row, column = {}, {}, family.E.shape[1], len(family.centre)
    for one in groups:
        first[one.name], free[one.name] = row, column
        row, column = row + len(one.shape), column + bool(one.spread)
    return first, free
