r"""The best that a detector could do that knows the noise and the true shape of what is hidden.

Notes
-----
Let d be the hidden signature and X the columns of all hypotheses, whitened, with the calibration projected
out. The scores of all columns are then ``N(X^T d, X^T X)``, whatever the data are, so the ideal detector's
answers are drawn from that distribution and no deployment is simulated. It weighs the truth (a single column
d, with as many degrees of freedom k as the cause has in the table) against every other cause of the table, by
the same evidence that the real detector uses, and its set holds all causes within 20:1 of the best.

An effect is *found* if one of the table's tests, or the truth's own, passes: ``chi2_k`` beyond its quantile
at 1 % divided among all causes and their independent hypotheses. The signal-to-noise of half detection, and
that of 95 %, are read off the draws with d scaled to other sizes.

Effects without a name are in :mod:`study.nameless`, two that are hidden at once in :mod:`study.both`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import chdtrc

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import slices
from magbridge.diagnose.descriptions import Description
from magbridge.diagnose.evidence import FALSE_ALARM_RATE, ODDS, log_bayes
from magbridge.diagnose.problem import pose
from magbridge.diagnose.survey import load_survey
from study.deployment import Background, Injected, compare, project
from study.draws import SHOWN, Draws, Span, by_cause, evidence, explained, numbers, with_another
from study.nameless import against, nameless
from study.noise import whiten

SIZES = np.linspace(1.0, 12.0, 45)
"""Signal-to-noise at which the chance to be found is evaluated."""


class Setting(NamedTuple):
    """What the ideal detector knows beside the log.

    Attributes
    ----------
    causes : mapping
        The whole table.
    look_elsewhere : mapping
        Cause -> number of independent hypotheses behind it.
    free : sequence of Description
        The detector's descriptions without a name, in the parts where the hidden effect has none.
    others : mapping of array (n,)
        Whitened true signatures of other causes, which compete beside the table's columns.
    """

    causes: Mapping[str, Cause]
    look_elsewhere: Mapping[str, float]
    free: Sequence[Description]
    others: Mapping[str, FloatArray]


def ideal(one: Injected, background: Background, ds: xr.Dataset, setting: Setting) -> dict[str, Any]:
    """Chances of an ideal detector.

    Parameters
    ----------
    one : Injected
        The hidden effect.
    background : Background
        The log that it is hidden in.
    ds : Dataset
        The deployment that is diagnosed.
    setting : Setting
        What the analyst may consider.

    Returns
    -------
    dict
        ``alone``: chance to name the truth alone; ``inside``: that the set holds it; ``size``: the set's mean
        size; ``first``: cause -> chance to be named first; ``half``, ``sure``: signal-to-noise at which 50
        and 95 % are found; ``here``: p-value with the noise of this very log, were the truth of the sizes
        :data:`SIZES`; ``apart``: cause -> signal-to-noise that its best imitation leaves. Where the setting
        has descriptions, ``two``: what the best two of any causes leave; ``unnamed`` and ``described``: see
        :mod:`study.nameless`.
    """
    name = one.hidden.name
    spans, S, noise = information([one], background, ds, setting)
    draws, competing = Draws.of(S), [span for span in spans if span.cause != name]
    best = best_of(S, competing)
    own = own_span(S, spans, name)
    true = true_span(S, own, name, len(S) - 1)
    given = {span: draws.ratio(span) for span in (*spans, true)}
    truth = evidence(true, *given[true])
    weighed = by_cause({span: evidence(span, *given[span]) for span in spans}, name, truth)
    names, table = list(weighed), np.array([*weighed.values()])
    inside, first, me = table > table.max(axis=0) - ODDS, np.argmax(table, axis=0), names.index(name)
    left = {
        c: with_another(draws, span, competing if setting.free else [r for r in competing if r.cause == c])
        for c, span in best.items()
        if explained(S, span)
    }
    answers = {
        "alone": float(np.mean((first == me) & (inside.sum(axis=0) == 1))) * bool(own),
        "inside": float(np.mean(inside[me])) * bool(own),
        "size": float(np.mean(inside.sum(axis=0))),
        "first": {cause: float(np.mean(first == j)) for j, cause in enumerate(names) if (first == j).any()},
        **_found(p_values(draws, [true, *competing], setting)),
        "here": np.median(p_values(Draws(S, noise), [true, *competing], setting), axis=1).tolist(),
        "apart": {c: left[c][c][0] if c in left else draws.wanted for c in best},
    }
    if not setting.free:
        return answers
    pairs = [(best[c], min(found.values(), key=lambda entry: entry[0])[1]) for c, found in left.items()]
    competing_evidence = by_cause({span: evidence(span, *given[span]) for span in competing})
    needed = against(draws, competing_evidence, pairs, setting.look_elsewhere)
    two = min(value for found in left.values() for value, _ in found.values())
    return answers | {"two": two} | nameless(draws, truth, needed, setting.free)


def information(
    hidden: Sequence[Injected], background: Background, ds: xr.Dataset, setting: Setting
) -> tuple[list[Span], FloatArray, FloatArray]:
    """Return spans, Fisher information (m, m) of all columns, and scores (m, 1) of the log's own noise.

    The hidden signatures are the last columns: each one and, if there are several, their sum.
    """
    noise, rows, calibration = background.noise, background.rows, background.deployment.calibration
    problem = pose(load_survey([ds], calibration), calibration)
    candidates = [c for cause in setting.causes.values() for c in cause.candidates(problem)]
    table = whiten(np.hstack([c.columns(slice(0, len(problem))) for c in candidates]), noise, rows)
    free = [whiten(description.columns(slice(0, len(problem))), noise, rows) for description in setting.free]
    truth = [one.signature for one in hidden]
    every = [sum(truth)] if len(truth) > 1 else []
    X = np.column_stack([*free, table, *setting.others.values(), *truth, *every])
    first = sum(columns.shape[1] for columns in free)
    spans = [
        Span(c.cause, c.channel, own, float(np.log(c.look_elsewhere)), c.positive, c.spectra)
        for c, own in zip(candidates, slices(candidates, first), strict=True)
    ]
    spans += [
        Span(cause, SHOWN, slice(k, k + 1), positive=cause == "filter_lag")
        for k, cause in enumerate(setting.others, first + table.shape[1])
    ]
    projected = project(X, background.columns, background.deployment.prior)
    measured = whiten(compare(ds, calibration)[0], noise, rows)
    return spans, X.T @ projected, projected.T @ (measured - sum(truth))[:, None]


def own_span(S: FloatArray, spans: Sequence[Span], name: str) -> Span | None:
    """Most evident hypothesis of the true cause; None if the log cannot test it."""
    return max((span for span in spans if span.cause == name), key=lambda span: _worth(S, span), default=None)


def true_span(S: FloatArray, own: Span | None, name: str, at: int) -> Span:
    """Return the true shape, which stands at `at`, with as many numbers as its cause's `own` hypothesis."""
    shape = slice(at, at + 1)
    if own is None:
        return Span(name, SHOWN, shape)
    return Span(name, SHOWN, shape, positive=own.positive, more=max(numbers(S, own), 1.0) - 1.0)


def best_of(S: FloatArray, spans: Sequence[Span]) -> dict[str, Span]:
    """Hypothesis of each cause that explains most of the truth."""
    found: dict[str, tuple[float, Span]] = {}
    for span in spans:
        found[span.cause] = max(
            (explained(S, span), span), found.get(span.cause, (-1.0, span)), key=lambda e: e[0]
        )
    return {cause: span for cause, (_, span) in found.items()}


def _worth(S: FloatArray, span: Span) -> float:
    """Log evidence of a hypothesis at its mean likelihood ratio."""
    freedom = numbers(S, span)
    return float(log_bayes(explained(S, span) + freedom, freedom))


def p_values(draws: Draws, spans: Sequence[Span], setting: Setting) -> FloatArray:
    """Smallest p-value of all tests, for each of :data:`SIZES` and each draw, look-elsewhere included."""
    scale, least = SIZES / draws.wanted, np.ones((len(SIZES), 1))
    for span in spans:
        ratio, freedom = draws.ratio(span, scale)
        if freedom:
            tests = span.tail * len(setting.causes) * setting.look_elsewhere.get(span.cause, 1.0)
            least = np.minimum(least, tests * chdtrc(freedom, np.maximum(ratio, 0.0)))
    return least


def _found(p: FloatArray) -> dict[str, float]:
    """Signal-to-noise at which 50 % and 95 % are found."""
    chance = np.maximum.accumulate(np.mean(p < FALSE_ALARM_RATE, axis=1))
    return {"half": float(np.interp(0.5, chance, SIZES)), "sure": float(np.interp(0.95, chance, SIZES))}
