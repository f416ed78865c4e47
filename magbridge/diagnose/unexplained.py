"""What is left: structure of any kind that no cause of the table accounts for, described but not named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import chi2

from magbridge.diagnose.candidates import Candidate
from magbridge.diagnose.joint import Joint, fit_joint, information
from magbridge.diagnose.noise import TAILS
from magbridge.diagnose.problem import Columns, Problem
from magbridge.diagnose.search import LEVEL, score, weigh

__all__ = ["Leftover", "Outliers", "kinds", "leftover", "outliers"]

FloatArray = NDArray[np.float64]


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
    """

    kind: str
    signal_to_noise: float
    p_value: float
    evidence: float
    period_s: float | None
    best_channel: str | None


class Outliers(NamedTuple):
    """Isolated wrong samples: which, twice the gain in log likelihood, and its p-value."""

    rows: NDArray[np.intp]
    ratio: float
    p_value: float


def kinds(problem: Problem) -> dict[str, tuple[Columns, int, float]]:
    """Flexible descriptions: kind -> (columns in units of a width, number of columns, hypotheses behind it)."""
    t = problem.survey.time
    n = len(t)
    u = (t - t[0]) / max(float(np.ptp(t)), 1.0)
    body = -problem.slopes[:, 6:]

    def projected(basis: FloatArray, width: float) -> Columns:
        """Each function of time along each axis of the body."""

        def columns(rows: slice) -> FloatArray:
            return np.asarray(
                (basis[rows, :, None] * body[rows, None, :]).reshape(basis[rows].shape[0], -1) * width
            )

        return columns

    slow = np.stack([np.cos(np.pi * k * u) for k in range(1, 13)], axis=1)
    pieces = (np.arange(n) * 16 // n)[:, None] == np.arange(1, 16)
    x = body / np.linalg.norm(body, axis=1)[:, None]
    powers = [x[:, 0] ** i * x[:, 1] ** j * x[:, 2] ** (4 - i - j) for i in range(5) for j in range(5 - i)]
    attitude = np.stack(powers, axis=1)
    return {
        "drift": (projected(slow, 10.0), 36, 1.0),
        "transient": (projected(pieces.astype(float), 20.0), 45, 1.0),
        "broadband": (lambda rows: 30.0 * attitude[rows], 15, 1.0),
    }


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
    columns = [candidate.columns for candidate in model]
    found = []
    for kind, (flexible, size, trials) in kinds(problem).items():
        info = information(problem, fit.noise, fit, columns, [flexible])
        s = score(info, slice(0, size))
        start = np.concatenate([fit.z, fit.coefficients, s.estimate])
        joint = fit_joint(problem, [*columns, flexible], order, start, ridge=1.0, rounds=4)
        found.append(_judge(kind, joint, fit, s.freedom, size, 4.0 * trials))
    if tone is not None:
        info = information(problem, fit.noise, fit, columns, [tone.columns])
        s = score(info, slice(0, tone.size))
        joint = fit_joint(
            problem, [*columns, tone.columns], order, np.concatenate([fit.z, fit.coefficients, s.estimate])
        )
        judged = _judge("tone", joint, fit, s.freedom, tone.size, tone.trials * 4)
        found.append(
            judged._replace(period_s=tone.shape["period"][0], evidence=judged.evidence - np.log(tone.trials))
        )
    # stricter than for a cause: with so many numbers the distribution is only asymptotic
    sure = [entry for entry in found if entry.p_value < 0.1 * LEVEL]
    if not sure:
        return None
    best = max(sure, key=lambda entry: entry.evidence)
    if best.kind == "transient":
        best = best._replace(kind=_steps(problem, fit))
    return best._replace(best_channel=_goes_with(problem, fit))


def _judge(kind: str, joint: Joint, base: Joint, freedom: int, size: int, hypotheses: float) -> Leftover:
    b = joint.coefficients[-size:]
    # many slow numbers against few independent samples: the ratio's mean is above its freedom (Bartlett 1937)
    independent = max(base.noise.independent, 2.0 * freedom)
    ratio = max(0.0, 2.0 * (joint.log_likelihood - base.log_likelihood)) * (1.0 - freedom / independent)
    p_value = min(1.0, hypotheses * float(chi2.sf(ratio, max(freedom, 1))))
    evidence = weigh(ratio, max(freedom, 1))
    own = np.linalg.inv(joint.covariance[-size:, -size:])
    # of the flexible fit's own numbers, those that the data determine
    power = max(float(b @ own @ b) - freedom, 0.0)
    return Leftover(kind, power**0.5, p_value, evidence, None, None)


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
