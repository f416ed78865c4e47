"""What is left: structure of any kind that no cause of the table accounts for, described but not named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import chi2

from magbridge.diagnose.candidates import Candidate
from magbridge.diagnose.causes.timing import field_rates
from magbridge.diagnose.joint import Joint, fit_joint, information
from magbridge.diagnose.noise import TAILS
from magbridge.diagnose.problem import Columns, Problem
from magbridge.diagnose.weigh import LEVEL, score, weigh

__all__ = ["Leftover", "Outliers", "flexible", "leftover", "outliers"]

FloatArray = NDArray[np.float64]

BURSTS = 64
"""Pieces of a log in which something may come and go."""
LOUD = 3
"""Descriptions beside the slow ones that are fitted jointly."""


class Leftover(NamedTuple):
    """Unexplained structure: its kind, size, and what it goes with.

    Attributes
    ----------
    kind : str
        ``switching drift tone transient broadband``.
    signal_to_noise, p_value : float
    evidence : float
        Log Bayes factor of the flexible description against the model.
    period_s : float or None
        Of a tone.
    best_channel : str or None
        The telemetry that goes with it best.
    channel : str or None
        The telemetry that the best description is a curve of.
    """

    kind: str
    signal_to_noise: float
    p_value: float
    evidence: float
    period_s: float | None
    best_channel: str | None
    channel: str | None = None


class Outliers(NamedTuple):
    """Isolated wrong samples: which, twice the gain in log likelihood, and its p-value."""

    rows: NDArray[np.intp]
    ratio: float
    p_value: float


class Flexible(NamedTuple):
    """A description without a name: columns in units of a width, how many, and the channel that it follows."""

    kind: str
    columns: Columns
    size: int
    channel: str | None = None


def flexible(problem: Problem) -> list[Flexible]:
    """List what structure of any kind is looked for with.

    Slow curves, steps and a function of attitude along each axis of the body, bursts along the field, the rates of
    change of the field, and a curve through each channel with the side that it came from.
    """
    t = problem.survey.time
    n = len(t)
    u = (t - t[0]) / max(float(np.ptp(t)), 1.0)
    body = -problem.slopes[:, 6:]
    x = body / np.linalg.norm(body, axis=1)[:, None]
    powers = [x[:, 0] ** i * x[:, 1] ** j * x[:, 2] ** (4 - i - j) for i in range(5) for j in range(5 - i)]
    attitude = np.stack(powers, axis=1)
    rates = field_rates(problem)
    place = np.arange(n)

    def projected(basis: Callable[[slice], FloatArray], width: float) -> Columns:
        """Each function of time along each axis of the body."""

        def columns(rows: slice) -> FloatArray:
            part = basis(rows)
            return np.asarray((part[:, :, None] * body[rows, None, :]).reshape(len(part), -1) * width)

        return columns

    def slow(rows: slice) -> FloatArray:
        return np.asarray(np.cos(np.pi * u[rows, None] * np.arange(1, 13)))

    def pieces(rows: slice, count: int = 16) -> FloatArray:
        return np.asarray((place[rows] * count // n)[:, None] == np.arange(1, count), float)

    def curve(values: FloatArray) -> Columns:
        y = 2.0 * (values - values.min()) / np.ptp(values) - 1.0
        moved = np.flatnonzero(np.abs(np.diff(y, prepend=y[0])) > 1e-3)
        came = np.zeros(n)
        if moved.size:
            last = np.searchsorted(moved, place, "right") - 1
            came = np.where(last >= 0, np.sign(np.diff(y, prepend=y[0])[moved[last]]), 0.0)
        return projected(
            lambda rows: np.stack([y[rows], y[rows] ** 2, y[rows] ** 3, y[rows] ** 4, came[rows]], 1), 30.0
        )

    listed = [
        Flexible("drift", projected(slow, 10.0), 36),
        Flexible("transient", projected(pieces, 20.0), 45),
        Flexible("broadband", lambda rows: 30.0 * attitude[rows], 15),
        Flexible(
            "transient", lambda rows: 20.0 * problem.gain[rows, None] * pieces(rows, BURSTS), BURSTS - 1
        ),
        Flexible("broadband", projected(lambda rows: rates[:, rows].T, 0.3), 9),
    ]
    return listed + [
        Flexible("broadband", curve(channel.values), 15, name)
        for name, channel in problem.survey.channels.items()
        if name not in problem.survey.still
    ]


def leftover(
    problem: Problem, model: Sequence[Candidate], fit: Joint, order: int, tone: Candidate | None = None
) -> Leftover | None:
    """Test whether anything is left beside `model`; the kind with the best evidence, or None.

    Parameters
    ----------
    problem, model, fit, order
        The model that was found.
    tone : Candidate, optional
        The best periodic disturbance, if the table does not hold that cause.
    """
    listed = flexible(problem)
    if tone is not None:
        listed.append(Flexible("tone", tone.columns, tone.size))
    columns = [candidate.columns for candidate in model]
    info = information(problem, fit.noise, fit, columns, [one.columns for one in listed])
    ends = np.cumsum([0, *(one.size for one in listed)])
    scores = [score(info, slice(int(a), int(b))) for a, b in pairwise(ends)]
    # slow ones the noise may have swallowed: they are always fitted; of the others those that have something to say
    loud = sorted(range(3, len(listed)), key=lambda k: -scores[k].evidence)[:LOUD]
    found = []
    for k in (0, 1, 2, *loud):
        one, s = listed[k], scores[k]
        index = np.arange(ends[k], ends[k + 1])
        start = np.append(info.moved(fit, index, s.estimate), s.estimate)
        joint = fit_joint(
            problem, [*columns, one.columns], order, start, np.append(start[: -one.size], np.zeros(one.size)),
            like=fit, ridge=1.0, rounds=3,
        )  # fmt: skip
        judged = _judge(
            one,
            joint,
            fit,
            s.freedom,
            float(len(listed)) * (tone.trials if tone and one.kind == "tone" else 1.0),
        )
        if tone is not None and one.kind == "tone":
            judged = judged._replace(
                period_s=tone.shape["period"][0], evidence=judged.evidence - float(np.log(tone.trials))
            )
        found.append(judged)
    # without a name stricter than for a cause: with so many numbers the distribution is only asymptotic
    sure = [entry for entry in found if entry.p_value < (LEVEL if model else 0.1 * LEVEL)]
    if not sure:
        return None
    best = max(sure, key=lambda entry: entry.evidence)
    if best.kind == "transient":
        best = best._replace(kind=_steps(problem, fit))
    return best if best.best_channel else best._replace(best_channel=_goes_with(problem, fit))


def _judge(one: Flexible, joint: Joint, base: Joint, freedom: int, hypotheses: float) -> Leftover:
    size = one.size
    b = joint.coefficients[-size:]
    # many slow numbers against few independent samples: the ratio's mean is above its freedom (Bartlett 1937)
    independent = max(base.noise.independent, 2.0 * freedom)
    ratio = max(0.0, 2.0 * (joint.log_likelihood - base.log_likelihood)) * (1.0 - freedom / independent)
    p_value = min(1.0, hypotheses * float(chi2.sf(ratio, max(freedom, 1))))
    evidence = weigh(ratio, max(freedom, 1))
    own = np.linalg.inv(joint.covariance[-size:, -size:])
    # of the flexible fit's own numbers, those that the data determine
    power = max(float(b @ own @ b) - freedom, 0.0)
    return Leftover(one.kind, power**0.5, p_value, evidence, None, one.channel, one.channel)


def _steps(problem: Problem, fit: Joint) -> str:
    """Tell one disturbance that comes and goes from a state that switches again and again."""
    n = len(problem)
    parts = np.arange(n) * min(64, max(n // 30, 2)) // n
    level: FloatArray = np.bincount(parts, fit.left) / np.bincount(parts)
    high = level > 0.5 * (level.max() + level.min())
    return "switching" if np.count_nonzero(np.diff(high.astype(int))) > 4 else "transient"


def _goes_with(problem: Problem, fit: Joint) -> str | None:
    """Return the channel of which a curve through ten bins explains most of what is left."""
    best: tuple[float, str | None] = (0.02, None)
    total = float(fit.left @ fit.left)
    for name, channel in problem.survey.channels.items():
        edges = np.unique(np.quantile(channel.values, np.linspace(0.1, 0.9, 9)))
        bins = np.searchsorted(edges, channel.values)
        count = np.maximum(np.bincount(bins), 1)
        explained = float(np.sum(np.bincount(bins, fit.left) ** 2 / count)) / total
        if explained > best[0]:
            best = (explained, name)
    return best[1]


def outliers(fit: Joint, causes: int) -> Outliers | None:
    """Test for isolated wrong samples: a few innovations from a wide distribution of their own.

    Heavy tails alone are no outliers: the mixture ``(1 - eps) t_nu + eps N(0, S^2)`` must beat the best ``t_nu``.
    """
    v = fit.noise.innovations
    n = len(v)
    alone = max(_mixture(v, nu, 0.0)[0] for nu in TAILS)
    if np.abs(v).max() < 5.0:
        return None
    value, member = max((_mixture(v, nu, 3.0 / n) for nu in TAILS[1:]), key=lambda found: found[0])
    ratio = 2.0 * (value - alone)
    p_value = min(1.0, causes * float(chi2.sf(ratio, 2)))
    rows = np.flatnonzero(member > 0.5)
    if p_value >= LEVEL or not rows.size or rows.size > 0.05 * n:
        return None
    # the memory of the noise throws a shadow of every wrong sample on the next
    first = rows[np.insert(np.diff(rows) > 1, 0, True)]
    return Outliers(first, ratio, p_value)


def _mixture(v: FloatArray, nu: float, eps: float) -> tuple[float, FloatArray]:
    """Log likelihood of the mixture after expectation maximisation, and each sample's chance to be wrong."""
    s, wide, member = (
        1.4826 * float(np.median(np.abs(v))),
        3.0 * float(np.abs(v).max()) / 3.0,
        np.zeros(len(v)),
    )
    value = -np.inf
    for _ in range(25):
        x = v / s
        if nu > 1e5:
            log_t = -0.5 * (x * x + np.log(2 * np.pi)) - np.log(s)
        else:
            c = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi)
            log_t = c - 0.5 * (nu + 1) * np.log1p(x * x / nu) - np.log(s)
        inside = np.exp(log_t) * (1.0 - eps)
        outside = eps * np.exp(-0.5 * (v / wide) ** 2) / (wide * np.sqrt(2 * np.pi))
        value = float(np.log(inside + outside + 1e-300).sum())
        if eps > 0.0:
            member = outside / (inside + outside + 1e-300)
            eps = max(float(member.mean()), 0.1 / len(v))
            wide = max(float(np.sqrt((member @ (v * v)) / (member.sum() + 1e-12))), 4.0 * s)
        weight = (1.0 - member) * (nu + 1.0) / (nu + x * x)
        s = float(np.sqrt((weight @ (v * v)) / (1.0 - member).sum()))
    return value, member
