r"""What a detector could do at best that knows the noise and the true shape of what is hidden.

Notes
-----
Let d be the hidden signature and X a rival's columns, whitened, with the calibration projected out. Scores of all
columns are then ``N(X^T d, X^T X)``, whatever the data were: so the ideal detector's answers are drawn from that
distribution without a deployment. It weighs the truth, a single column d with as many free numbers as the cause has in
the table, against every other cause of the table by the same evidence that the real one uses, and names all within 20:1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magbridge.diagnose.causes import Cause
from magbridge.diagnose.problem import pose
from magbridge.diagnose.survey import take
from study.stage import Found, Stall, project, whiten

Array = NDArray[np.float64]
DRAWS = 200
ODDS = float(np.log(20.0))


def ideal(
    one: Found, stall: Stall, ds: xr.Dataset, causes: Mapping[str, Cause], others: Mapping[str, Array]
) -> dict[str, Any]:
    """Chances of an ideal detector.

    Parameters
    ----------
    one : Found
        What is hidden.
    stall : Stall
        Where.
    ds : Dataset
        The deployment that is diagnosed.
    causes : mapping
        The table of causes.
    others : mapping of array (n,)
        Whitened true signatures of other causes, beside what the table makes of them.

    Returns
    -------
    dict
        ``alone``: chance to name the truth alone; ``inside``: that the set holds it; ``size``: the set's mean size;
        ``first``: cause -> chance to be named first; ``own``: share of the signal-to-noise that the table's regressors
        of the true cause reach; ``apart``: cause -> signal-to-noise that its best imitation leaves, of up to two of its
        regressors; ``unlike`` and ``mimic``: the smallest of those, and whose it is; ``two``: what the best two of any
        causes leave.
    """
    name = one.hidden.name
    spans, S = _information(one, stall, ds, causes, others)
    values, vectors = np.linalg.eigh(0.5 * (S + S.T))
    rng = np.random.default_rng(20131212)
    spread = rng.standard_normal((len(S), DRAWS)) * np.sqrt(np.maximum(values, 0.0))[:, None]
    scores = S[:, -1:] + vectors @ spread
    groups: dict[tuple[str, str | None], list[tuple[Array, float]]] = {}
    # of each cause what it explains of the truth, with how many numbers, and where they stand
    best: dict[str, tuple[float, int, slice]] = {}
    for span in spans:
        root, given, drawn = _root(S[span.own, span.own]), S[span.own, -1:], scores[span.own]
        if span.cause == "filter_lag":  # it cannot lead
            given, drawn = np.maximum(given, 0.0), np.maximum(drawn, 0.0)
        explained = float(np.sum((root.T @ given) ** 2))
        if explained >= best.get(span.cause, (0.0,))[0]:
            best[span.cause] = explained, root.shape[1], span.own
        evidence = weigh(np.sum((root.T @ drawn) ** 2, axis=0), root.shape[1])
        groups.setdefault((span.cause, span.channel), []).append((evidence, span.price))
    testable = name in best  # what the log cannot test, nobody names
    reached, k, _ = best.pop(name, (0.0, 1, slice(0)))
    # its k - 1 other numbers fit nothing but noise
    truth = scores[-1] ** 2 / S[-1, -1] + 2.0 * rng.standard_gamma(0.5 * (k - 1), DRAWS)
    weighed = _by_cause(groups, name, weigh(truth, k))
    names, table = list(weighed), np.array([*weighed.values()])
    inside, first, me = table > table.max(axis=0) - ODDS, np.argmax(table, axis=0), names.index(name)
    wanted = float(np.sqrt(S[-1, -1]))
    rivals = [span for span in spans if span.cause != name]
    left = {cause: with_another(S, own, rivals) for cause, (like, _, own) in best.items() if like}
    apart = {cause: left[cause][cause] if like else wanted for cause, (like, _, _) in best.items()}
    return {
        "alone": float(np.mean((first == me) & (inside.sum(axis=0) == 1))) * testable,
        "inside": float(np.mean(inside[me])) * testable,
        "size": float(np.mean(inside.sum(axis=0))),
        "first": {cause: float(np.mean(first == j)) for j, cause in enumerate(names) if (first == j).any()},
        "own": float(np.sqrt(reached / S[-1, -1])),
        "apart": apart,
        "unlike": min(apart.values()),
        "mimic": min(apart, key=lambda cause: apart[cause]),
        "two": min(value for found in left.values() for value in found.values()),
    }


class Span(NamedTuple):
    """One of a cause's hypotheses: its columns, and the log of how many others it stands for."""

    cause: str
    channel: str | None
    own: slice
    price: float


def _information(
    one: Found, stall: Stall, ds: xr.Dataset, causes: Mapping[str, Cause], others: Mapping[str, Array]
) -> tuple[list[Span], Array]:
    """Fisher's information of every hypothesis' columns, with the truth's as the last one, calibration free."""
    problem = pose(take([ds], stall.stage.calibration), stall.stage.calibration)
    candidates = [c for cause in causes.values() for c in cause.candidates(problem)]
    table = whiten(np.hstack([c.columns(slice(0, len(problem))) for c in candidates]), stall.noise)
    X = np.column_stack([table, *others.values(), one.signature])
    ends = np.cumsum([c.size for c in candidates]).tolist()
    spans = [
        Span(c.cause, c.channel, slice(end - c.size, end), float(np.log(c.trials)))
        for c, end in zip(candidates, ends, strict=True)
    ]
    spans += [Span(cause, "", slice(k, k + 1), 0.0) for k, cause in enumerate(others, table.shape[1])]
    return spans, X.T @ project(X, stall.columns, stall.stage.prior)


def weigh(ratio: Array, freedom: int) -> Array:
    """Log evidence of likelihood ratios that took so many free numbers (Liang et al. 2008, sec. 2.4)."""
    if not freedom:
        return np.zeros_like(ratio)
    more = np.maximum(ratio, freedom)
    return np.asarray(0.5 * (more - freedom) - 0.5 * freedom * np.log(more / freedom))


def with_another(S: Array, own: slice, spans: Sequence[Span]) -> dict[str, float]:
    """Signal-to-noise of the truth (the last of S) that the columns at `own` leave with the best other of each cause."""
    taken = S[:, own] @ _root(S[own, own])
    S = S - taken @ taken.T
    left: dict[str, float] = {}
    for span in spans:
        explained = float(np.sum((_root(S[span.own, span.own]).T @ S[span.own, -1:]) ** 2))
        left[span.cause] = min(left.get(span.cause, np.inf), float(S[-1, -1]) - explained)
    return {cause: float(np.sqrt(max(value, 0.0))) for cause, value in left.items()}


def _root(S: Array) -> Array:
    """Return R (k, f) with ``R R^T`` the inverse of S in the directions that the data see."""
    values, vectors = np.linalg.eigh(S)
    seen = values > 1e-3
    return np.asarray(vectors[:, seen] / np.sqrt(values[seen]))


def _by_cause(
    groups: Mapping[tuple[str, str | None], list[tuple[Array, float]]], name: str, truth: Array
) -> dict[str, Array]:
    """Each cause's evidence, averaged over its grid, of its best channel; the truth pays for its grid as the others do."""
    found: dict[str, Array] = {}
    for (cause, _), members in groups.items():
        table = np.array([evidence for evidence, _ in members])
        top = table.max(axis=0)
        price = np.log(np.mean(np.exp(table - top), axis=0)) - members[0][1]
        own = (truth if cause == name else top) + price
        found[cause] = np.maximum(found.get(cause, own), own)
    return found if name in found else found | {name: truth}
