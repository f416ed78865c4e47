r"""The causes that a log with this calibration can show, and those that it cannot distinguish.

Notes
-----
The information S of a cause's coefficients needs telemetry, attitude and the noise level, but no residual.
An effect of signal-to-noise a is found with the chance that a noncentral chi-square of k degrees of freedom
and noncentrality ``a^2`` passes the threshold. Between two causes whose signatures, whitened and projected,
correlate by rho, the wrong one wins with the chance ``Phi(-a sqrt(1 - rho^2) / 2)`` (two points in
Gaussian noise).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtri, chndtrinc

from magbridge.diagnose.causes.candidates import Candidate, Group, slices
from magbridge.diagnose.inference.evidence import FALSE_ALARM_RATE, score
from magbridge.diagnose.inference.information import Information

__all__ = [
    "CONFOUNDED", "MAX_PLAUSIBLE_MULTIPLE", "Isolability", "Visible", "isolability", "likeness",
    "most_visible",
]  # fmt: skip

CONFOUNDED = 0.85
"""Correlation beyond which two causes are listed as a pair: at this one they are distinguished in 95 of 100
cases at signal-to-noise 6."""

MAX_PLAUSIBLE_MULTIPLE = 50.0
"""Multiple of its plausible size from which on a cause is not plausible at all."""
FREE = 1e-3
"""Prior precision, in units of a plausible size's, of coefficients that are each free; it is 1 for those of
one common size."""


@dataclass(frozen=True)
class Visible:
    """How large one cause must be to be found."""

    cause: str
    channel: str | None
    sizes: dict[str, tuple[float, str]]
    """Coefficient -> (size that is found with 95 %, unit); infinite where the log cannot show it."""


@dataclass(frozen=True)
class Isolability:
    """What a log can show, before its residual is looked at."""

    visible: tuple[Visible, ...]
    pairs: tuple[tuple[Visible, Visible, float], ...]
    """Causes with correlated effects, and their correlation."""
    untestable: dict[str, str]
    """Cause that this log cannot test -> what a log would need for it."""


def isolability(
    candidates: Sequence[Candidate],
    info: Information,
    look_elsewhere: Mapping[str, float],
    causes: int,
    untestable: Mapping[str, str],
) -> Isolability:
    """Evaluate `info`; the candidate that the log shows best stands for the whole grid of its cause."""
    at = slices(candidates)
    picked = most_visible(candidates, info, at)
    among = [candidates[k].tail * causes * look_elsewhere.get(candidates[k].cause, 1.0) for k in picked]
    visible = [_visible(candidates[k], info, at[k], count) for k, count in zip(picked, among, strict=True)]
    pairs = [
        (one, other, likeness(info, candidates[a], at[a], candidates[b], at[b]))
        for (one, a), (other, b) in combinations(zip(visible, picked, strict=True), 2)
        if one.cause != other.cause
    ]
    alike = sorted((pair for pair in pairs if pair[2] > CONFOUNDED), key=lambda pair: -pair[2])
    return Isolability(tuple(visible), tuple(alike), dict(untestable))


def most_visible(candidates: Sequence[Candidate], info: Information, at: Sequence[slice]) -> list[int]:
    """Return the place of the candidate of each cause and channel that the log shows best."""
    best: dict[Group, tuple[float, int]] = {}
    for k, candidate in enumerate(candidates):
        total = float(np.trace(info.matrix[at[k], at[k]])) / candidate.size
        if total > best.get(candidate.group, (-1.0, 0))[0]:
            best[candidate.group] = (total, k)
    return [k for _, k in best.values()]


def _visible(candidate: Candidate, info: Information, own: slice, hypotheses: float) -> Visible:
    """Return the signal-to-noise and the sizes at which a candidate is found among so many hypotheses."""
    freedom = max(score(info, own, candidate).freedom, 1)
    sure = float(np.sqrt(chndtrinc(chdtri(freedom, FALSE_ALARM_RATE / hypotheses), freedom, 0.05)))
    power = np.diag(info.matrix[own, own])
    if candidate.spectra is not None:  # what counts is what all of them do together
        x = sure / float(np.sqrt(max(power.sum(), 1e-300)))
        sizes = {"size": (_plausible(x), "times the usual one")}
    else:
        size = sure / np.sqrt(np.maximum(power, 1e-300))
        sizes = {
            name: (_plausible(float(x)) * float(w), unit)
            for name, x, w, unit in zip(candidate.names, size, candidate.width, candidate.units, strict=True)
        }
    return Visible(candidate.cause, candidate.channel, sizes)


def _plausible(size: float) -> float:
    """Return a size in units of a plausible one; infinite where nothing plausible would show."""
    return size if size < MAX_PLAUSIBLE_MULTIPLE else float("inf")


def likeness(info: Information, one: Candidate, a: slice, other: Candidate, b: slice) -> float:
    """Correlation of two signatures: root of the mean share that one can imitate of the other, the larger."""
    A, B, C = info.matrix[a, a], info.matrix[b, b], info.matrix[a, b]
    p, q = (FREE if candidate.spectra is None else 1.0 for candidate in (one, other))
    M = C @ np.linalg.solve(B + q * np.eye(len(B)), C.T)
    N = C.T @ np.linalg.solve(A + p * np.eye(len(A)), C)
    shares = [float(np.trace(X) / (np.trace(Y) + 1e-12)) for X, Y in ((M, A), (N, B))]
    return float(np.sqrt(np.clip(max(shares), 0.0, 1.0)))
