r"""Whether an ideal analyst would name two causes that are hidden at once.

Notes
-----
The analyst does not know which two are hidden, and weighs every cause alone and every pair of causes. The log
evidence of a pair is that of the first cause, plus that of the second beside it, in the better of the two
orders. Every cause pays for its independent hypotheses; the second also pays 20:1, and for its choice among
the causes. The analyst names the model (one cause or a pair) of the best evidence; the set holds the causes
of all models within 20:1 of it.

*both* is the chance to name the two if their true shapes are known beside the table's columns, *inside* that
the set holds them, and *regressed* the chance to name them with the table's columns alone: what those leave
of one cause may look like another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.diagnose.evidence import ODDS
from study.deployment import Background, Injected
from study.draws import SHOWN, Draws, Span, evidence
from study.theory import Setting, best_of, information, own_span, true_span

Wholes = dict[frozenset[str], FloatArray]


def both(
    hidden: Sequence[Injected], background: Background, ds: xr.Dataset, setting: Setting
) -> dict[str, float]:
    """Chances of the module's notes; see :func:`study.theory.ideal`."""
    spans, S, _ = information(hidden, background, ds, setting)
    draws, table = Draws.of(S), {span for span in spans if span.channel != SHOWN}
    truth = frozenset(one.hidden.name for one in hidden)
    likely, last = [*best_of(S, spans).values()], len(S) - 1 - len(hidden)
    shown = []
    for k, one in enumerate(hidden, last):
        alone = S[np.ix_([*range(last), k], [*range(last), k])]
        own = own_span(alone, spans, one.hidden.name)
        if own is None:
            return dict.fromkeys(("both", "inside", "regressed"), 0.0)
        likely.append(own)
        shown.append(true_span(alone, own, one.hidden.name, k))
    values = weighed(draws, [*spans, *shown], [*likely, *shown], setting.look_elsewhere)
    known = by_causes(values)
    regressed = by_causes({some: value for some, value in values.items() if table.issuperset(some)})
    return {"both": named(known, truth), "inside": held(known, truth), "regressed": named(regressed, truth)}


def weighed(
    draws: Draws, spans: Sequence[Span], firsts: Sequence[Span], look_elsewhere: Mapping[str, float]
) -> dict[tuple[Span, ...], FloatArray]:
    """Log evidence of every span, and of each two of different causes whose first is in `firsts`."""

    def own(draws: Draws, span: Span) -> FloatArray:
        return np.asarray(evidence(span, *draws.ratio(span)) - np.log(look_elsewhere.get(span.cause, 1.0)))

    values: dict[tuple[Span, ...], FloatArray] = {(span,): own(draws, span) for span in spans}
    price = ODDS + np.log(max(len(look_elsewhere), 1))
    for first in firsts:
        conditional_on = draws.conditional_on(first)
        for span in spans:
            if span.cause != first.cause:
                values[first, span] = values[first,] + own(conditional_on, span) - price
    return values


def by_causes(values: Mapping[tuple[Span, ...], FloatArray]) -> Wholes:
    """Return the best log evidence of every set of causes."""
    wholes: Wholes = {}
    for spans, value in values.items():
        whole = frozenset(span.cause for span in spans)
        wholes[whole] = np.maximum(wholes.get(whole, value), value)
    return wholes


def named(wholes: Wholes, truth: frozenset[str]) -> float:
    """Chance that the true set of causes has the best evidence."""
    best = np.max([*wholes.values()], axis=0)
    return float(np.mean(wholes[truth] >= best)) if truth in wholes else 0.0


def held(wholes: Wholes, truth: frozenset[str]) -> float:
    """Chance that each true cause is in a model within 20:1 of the best."""
    near = np.max([*wholes.values()], axis=0) - ODDS
    inside = [
        np.max([value for whole, value in wholes.items() if cause in whole], axis=0, initial=-np.inf) > near
        for cause in truth
    ]
    return float(np.mean(np.all(inside, axis=0)))
