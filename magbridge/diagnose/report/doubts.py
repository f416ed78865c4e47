"""What to know before believing a finding: a paragraph each, empty where there is nothing to say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from scipy.stats import chi2

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Calibration
from magbridge.calibration.residual import residuals, residuals_of
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.compare.derivatives import CHUNK, derivatives
from magbridge.diagnose.compare.problem import DELAY, DELAYS, Problem, samples_of
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.gain import Gain
from magbridge.diagnose.inference.evidence import LEVEL
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.rivals import Rival
from magbridge.diagnose.report.words import label, listed, measured, number
from magbridge.diagnose.unexplained.leftover import Leftover

__all__ = [
    "IMPLAUSIBLE",
    "doubts",
    "gained",
    "late",
    "nameless",
    "stays",
    "times_usual",
    "unsettled",
    "useful",
]

REFERENCE = ("map_error", "reference_bias", "diurnal_variation")
"""Causes that are errors of the reference."""
IMPLAUSIBLE = 5.0
"""Multiple of its plausible size above which a cause is doubted."""
SEVERAL = (
    '<p class="faint">A number in brackets: several such terms were needed to describe the cause; they act '
    "together.</p>"
)
RECENT = (
    "It is best described as absent from the logs that the calibration was fitted to: it may have appeared "
    "since."
)
GROUNDED = (
    "It is not in the extended calibration: live, a rate of change is a backward difference, whose noise "
    "would exceed what the correction gains."
)
NO_GAIN = "It shows no gain on what was left out of the fit: it may be a remnant of another effect."
OUTSHONE = "The unexplained rest is stronger than this cause, and may have caused part of it."


def doubts(diagnosis: Diagnosis, finding: Finding, cause: Cause) -> list[str]:
    """Return the paragraphs on one finding; `cause` is its row in the table of causes."""
    candidate, rest = finding.candidate, diagnosis.unexplained
    said = {
        RECENT: any(piece.since for piece in candidate.pieces),
        GROUNDED: not set(candidate.effects) <= set(diagnosis.calibration.effects),
        NO_GAIN: not finding.gain.shown,
        OUTSHONE: rest is not None and rest.signal_to_noise >= finding.signal_to_noise,
    }
    return [
        SEVERAL * any(name.endswith(")") for name in candidate.names),
        implausible(candidate, finding.coefficients),
        in_motion(diagnosis, finding),
        shortened(finding),
        rivalled(candidate, cause, finding.rivals, finding.chance_alone),
        *(f"<p>{text}</p>" for text, so in said.items() if so),
    ]


def late(problem: Problem, fit: Joint) -> str:
    """Say so when the channels look interpolated, which adds a noise that no calibration can undo."""
    delays, to_x = np.arange(len(fit.z))[DELAYS], np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    later = DELAY * to_x @ fit.z[delays]
    covariance = DELAY**2 * to_x @ fit.covariance[np.ix_(delays, delays)] @ to_x.T
    if chi2.sf(later @ np.linalg.solve(covariance, later), later.size) >= LEVEL:
        return ""
    y, z = (
        f"{measured(x, s)} ± {measured(s, s)} s"
        for x, s in zip(later, np.sqrt(np.diag(covariance)), strict=True)
    )
    taken = float(np.std(problem.straight(fit.z) - problem.residual))
    return (
        "<p>The channels look as if they were sampled in turn and interpolated to the time of each row: y "
        f"{y} and z {z} later than x (a channel that is noisier than the others would look the same). The "
        f"{number(taken)} nT RMS that this causes is removed from what follows. To avoid it, sample all "
        "three channels at once, or faster than the vehicle sways. A log that gives each channel's own time "
        "(mag_time_x, mag_time_y, mag_time_z) loses less, because its channels are interpolated here, to "
        "third order; of such a log, these delays are only what that leaves.</p>"
    )


def implausible(candidate: Candidate, b: FloatArray) -> str:
    """Say so when a cause's b (k,), in units of its widths, is implausibly large, as if two cancelled."""
    times = times_usual(candidate, b)
    if times < IMPLAUSIBLE:
        return ""
    return (
        f"<p>This is {number(times, 2)} times the usual size of such a cause. Two causes that cancel each "
        "other can grow this large: check the extended calibration against another reference before it is "
        "flown.</p>"
    )


def times_usual(candidate: Candidate, b: FloatArray) -> float:
    """Return how many times its plausible size a cause of b (k,) is; 0 where its terms share one size."""
    return float(np.abs(b).max()) if candidate.spectra is None else 0.0


def shortened(finding: Finding) -> str:
    """Say what becomes of a filter's attenuation: the calibration is free of it, a turning field is not."""
    variance = dict(zip(finding.candidate.names, finding.coefficients, strict=True)).get("variance", 0.0)
    if variance <= 0.0:
        return ""
    return (
        "<p>It shortens a field that turns, as an RC filter of "
        f"{number(0.5 / np.pi / np.sqrt(variance), 2)} Hz does. The extended calibration is fitted without "
        "that, as with calibrate --filter-corner. In turns the corrected field stays too short.</p>"
    )


def in_motion(diagnosis: Diagnosis, finding: Finding) -> str:
    """Say so when a cause acts while masses move: one that moved unseen between rows looks the same."""
    survey = diagnosis.problem.survey
    p = survey.values([parameter.name for parameter in diagnosis.problem.calibration.parameters])
    steps = np.any(np.diff(p, axis=0) != 0.0, axis=1)
    moving = np.append(steps, False) | np.append(False, steps)
    power = (finding.candidate.columns(slice(0, len(survey))) @ finding.coefficients) ** 2
    share, usual = float(power[moving].sum() / power.sum()), float(moving.mean())
    if usual > 0.5 or share < 0.8:
        return ""
    interval = float(np.median(np.diff(survey.time)))
    return (
        f"<p>{100 * share:.0f} % of its power lies in the {100 * usual:.0f} % of samples next to which a "
        f"mass moved. With {interval:.3g} s between rows, a mass that was not where its row says would look "
        "the same.</p>"
    )


def gained(gain: Gain, parts: str) -> str:
    """Tell what all findings together gain on what was left out, and say so when that shows no gain."""
    low, high = gain.interval
    return (
        f"On {parts} left out of the fit, {number(gain.before)} nT RMS became {number(gain.after)} nT "
        f"(ratio {gain.ratio:.2f}, 95 % interval {low:.2f} to "
        f"{high:.2f}{'' if gain.shown else ': no gain is shown'})."
    )


def stays(diagnosis: Diagnosis) -> list[Candidate]:
    """Return the named causes that the extended calibration does not correct for."""
    added = diagnosis.calibration.effects
    return [c for c in diagnosis.named if not c.effects or any(effect not in added for effect in c.effects)]


def useful(diagnosis: Diagnosis) -> str:
    """Say what the extended calibration corrects for and what not; nothing where nothing was added to it."""
    added = diagnosis.calibration.effects
    if all(c.cause in REFERENCE or (c.effects and set(added).isdisjoint(c.effects)) for c in diagnosis.named):
        return ""
    others = ", ".join(escape(label(*candidate.group)) for candidate in stays(diagnosis))
    but = f" It leaves {others} in the field, which the RMS above has removed." if others else ""
    verdict = (
        "corrects for what belongs to the vehicle and its sensor"
        if diagnosis.total.shown
        else "shows no gain on what it was not fitted to: do not fly it before another log does"
    )
    return f"The extended calibration, <code>calibration.json</code> beside this page, {verdict}.{but}"


def rivalled(candidate: Candidate, cause: Cause, rivals: Sequence[Rival], chance: float) -> str:
    """Say which causes could take its place, what would tell them apart, and what theory expects."""
    theory = (
        "By theory, an effect of this size in such a log would be told from all other known causes in "
        f"{'more than 99' if chance > 0.995 else f'{100 * chance:.0f}'} of 100 cases"
    )
    alone = "No other known cause explains the data nearly as well (none comes within odds of 20:1)."
    if not rivals:
        return f"<p><b>Alternatives:</b> none. {alone} {theory}.</p>"
    if all(rival.candidate.cause == candidate.cause for rival in rivals):
        channels = ", ".join(escape(str(rival.candidate.channel)) for rival in rivals)
        return (
            f"<p><b>Alternatives:</b> only in the channel. {alone} Which channel it follows is less sure: "
            f"{channels} would do nearly as well (odds below 20:1). A log in which these channels differ "
            f"more would tell. {theory}.</p>"
        )
    return (
        f"<p><b>Alternatives:</b> the data cannot tell it from {listed(rivals, ' or ')} (odds below 20:1). "
        f"{theory}; here it was not.</p><p><b>To tell them apart:</b> {escape(cause.separated_by)}.</p>"
    )


def unsettled(problem: Problem, possible: Sequence[Candidate], extended: Calibration) -> str:
    """Say how far the corrected field is shifted as a whole, and how surely, if the reference may be wrong.

    That is, if an error of it is among the causes named or the rivals of one. A constant may belong to either
    then. Nothing is said where shift and sigma are below the noise.
    """
    if not any(candidate.cause in REFERENCE for candidate in possible):
        return ""
    survey = problem.survey
    before = residuals_of(*samples_of(survey, problem.calibration))
    samples, coefficients = samples_of(survey, extended)
    after, g = residuals(samples, coefficients)
    fresh = np.flatnonzero(~survey.learned)
    shift = float((after - before)[fresh].mean())
    some = fresh[:: 1 + fresh.size // CHUNK]  # enough for a mean
    every = np.eye(extended.coefficients.size)
    slope = derivatives(extended, samples.part(some), g[some], every).mean(axis=0)
    sigma = float(np.sqrt(slope @ extended.covariance @ slope))
    if max(abs(shift), sigma) < extended.noise.sensor:
        return ""
    return (
        f"the extended calibration shifts the whole corrected field by {shift:+.1f} nT, to within "
        f"{max(sigma, 0.1):.1f} nT (1 sigma, if the names are right), and a log cannot tell for sure whether "
        "a constant belongs to the vehicle or to the reference; check the extended field against another "
        "reference before using it"
    )


def nameless(rest: Leftover, causes: Mapping[str, Cause]) -> str:
    """Say why the rest has no name, and what would tell the possible causes apart."""
    if not rest.within:
        return "It fits no known cause, so it has no name."
    return (
        "No name is asserted: a description without a cause is likelier than any known cause, but by "
        f"less than 20:1 and what a cause's idealised shape may miss. Not ruled out: {listed(rest.within)}. "
        f"To tell: {escape(causes[rest.within[0].candidate.cause].separated_by)}."
    )
