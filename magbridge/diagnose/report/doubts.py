"""What a reader should know before a finding is believed: a paragraph each, empty where there is nothing to say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from magbridge.diagnose.compare.problem import DELAY, DELAYS, Problem
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.weigh import LEVEL
from magbridge.diagnose.report.words import listed, measured, number

if TYPE_CHECKING:
    from magbridge.diagnose.causes import Cause
    from magbridge.diagnose.causes.candidates import Candidate
    from magbridge.diagnose.diagnosis import Diagnosis
    from magbridge.diagnose.gain import Gain
    from magbridge.diagnose.inference.rivals import Rival
    from magbridge.diagnose.inference.search import Hypothesis
    from magbridge.diagnose.inference.unexplained import Leftover

__all__ = [
    "grounded",
    "implausible",
    "in_motion",
    "late",
    "nameless",
    "no_gain",
    "outshone",
    "rivalled",
    "several",
]

IMPLAUSIBLE = 5.0
"""Times its plausible size: a cause that is larger is doubted."""


def late(problem: Problem, fit: Joint) -> str:
    """Say so when channels were brought to their rows from other times: what that leaves, no calibration can mend."""
    own, to_x = np.arange(len(fit.z))[DELAYS], np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    later = DELAY * to_x @ fit.z[own]
    covariance = DELAY**2 * to_x @ fit.covariance[np.ix_(own, own)] @ to_x.T
    if chi2.sf(later @ np.linalg.solve(covariance, later), later.size) >= LEVEL:
        return ""
    y, z = (
        f"{measured(x, s)} ± {measured(s, s)} s"
        for x, s in zip(later, np.sqrt(np.diag(covariance)), strict=True)
    )
    taken = float(np.std(problem.straight(fit.z) - problem.residual))
    return (
        f"<p>The channels look as if they had been taken in turn and interpolated to their rows: y {y} and z {z} later than x (one "
        f"that is noisier than the others looks like that, too). The {number(taken)} nT RMS that this makes are taken out of what "
        "follows. A converter that takes all three at once would not have it, nor rows that come faster than the vehicle sways; of channels "
        "as they were read, each with its time (mag_time_x, mag_time_y, mag_time_z), less is lost than of a log's own interpolation.</p>"
    )


def several(names: tuple[str, ...]) -> str:
    """Say what a number in brackets means."""
    if not any(name.endswith(")") for name in names):
        return ""
    return '<p class="faint">A number in brackets: the cause took more than one such term to describe; they act together.</p>'


def implausible(candidate: Candidate, b: NDArray[np.float64]) -> str:
    """Say so when a cause is larger than such causes are: two that cancel each other grow together."""
    times = float(np.abs(b).max())
    if candidate.spectra is not None or times < IMPLAUSIBLE:
        return ""
    return (
        f"<p>This is {number(times, 2)} times what such a cause usually amounts to. Two causes that cancel each other can grow like "
        "that: hold the extended field against another reference before it is flown.</p>"
    )


def grounded(diagnosis: Diagnosis, candidate: Candidate) -> str:
    """Say so when a cause is named but not flown with."""
    if all(effect in diagnosis.calibration.effects for effect in candidate.effects):
        return ""
    return (
        "<p>It is not in the extended calibration: live, where a rate is a difference backwards, it would bring in more than it takes "
        "away.</p>"
    )


def in_motion(diagnosis: Diagnosis, at: int, candidate: Candidate) -> str:
    """Say so when a cause acts while masses move: a mass that moved between two rows, unseen, looks like that, too."""
    survey = diagnosis.problem.survey
    p = survey.values([parameter.name for parameter in diagnosis.problem.calibration.parameters])
    steps = np.any(np.diff(p, axis=0) != 0.0, axis=1)
    moving = np.append(steps, False) | np.append(False, steps)
    b = diagnosis.fit.coefficients[at : at + candidate.size]
    power = (candidate.columns(slice(0, len(survey))) @ b) ** 2
    share, usual = float(power[moving].sum() / power.sum()), float(moving.mean())
    if usual > 0.5 or share < 0.8:
        return ""
    interval = float(np.median(np.diff(survey.time)))
    return (
        f"<p>{100 * share:.0f} % of its trace lies in the {100 * usual:.0f} % of the samples next to which a mass moved. With "
        f"{interval:.3g} s from row to row, a mass that was elsewhere than its row says would look like that, too.</p>"
    )


def no_gain(gain: Gain) -> str:
    """Say so when what was left out shows nothing of it."""
    if gain.interval[1] < 1.0:
        return ""
    return "<p>What was left out of the fit does not show that it gains anything: it may be what another effect leaves.</p>"


def outshone(hypothesis: Hypothesis, rest: Leftover | None) -> str:
    """Say so when what is left without a name is louder than a cause that has one."""
    if rest is None or rest.signal_to_noise < hypothesis.signal_to_noise:
        return ""
    return "<p>What is left without a name is louder than this, and may have made some of it.</p>"


def rivalled(cause: Cause, rivals: Sequence[Rival], chance: float) -> str:
    """Say which causes could stand in its place, what would tell them apart, and what theory expects."""
    if not rivals:
        return (
            "<p>No other cause of the table comes within 20:1.</p>"
            f"<p>In a log like this one, theory gives it a chance of {100 * chance:.0f} % to be named alone.</p>"
        )
    return (
        f"<p>The data cannot tell it from {listed(rivals)} (odds below 20:1). What would: {escape(cause.separated_by)}.</p>"
        f"<p>In a log like this one, theory gives it a chance of {100 * chance:.0f} % to be named alone; here it was not.</p>"
    )


def nameless(rest: Leftover, causes: Mapping[str, Cause]) -> str:
    """Say why what is left has no name, and what would tell those apart that are not ruled out."""
    if not rest.within:
        return "It fits no cause of the table, so it has no name."
    return (
        f"No name is asserted: it is likelier than any cause of the table, by less than 20:1. Not ruled out: {listed(rest.within)}. What would "
        f"tell: {escape(causes[rest.within[0].cause].separated_by)}."
    )
