"""The page's section on what is left: the residual that was predicted, and the one that remains."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.words import listed, number, table
from magbridge.diagnose.unexplained.leftover import Leftover

__all__ = ["described", "nameless", "remaining"]

KINDS = {
    "switching": "Something that switches or comes and goes",
    "drift": "A slow drift",
    "tone": "A tone",
    "transient": "A transient",
    "broadband": "Something broadband",
}
"""What is left, as the subject of a sentence."""
WORSE = 1.3
"""Multiple of the fitted residual from which the one held out is remarked on."""


def remaining(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Return the section; `causes` is the table of causes that were asked about."""
    return [_left(diagnosis, causes), *_budget(diagnosis), f"<p>{_noise(diagnosis)}</p>"]


def _left(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> str:
    rest = diagnosis.unexplained
    if rest is None:
        return f"<p>No description of the list stands out of what is left. {_followed(diagnosis)}</p>"
    return f"<p>{described(rest)}. {_followed(diagnosis)} {nameless(rest, causes)}</p>"


def _followed(diagnosis: Diagnosis) -> str:
    """Say how large and how slow what is left is, and what it goes with."""
    left, goes = diagnosis.assessment.residual, diagnosis.assessment.follows
    axis = "along the field" if goes.axis == "field" else f"mostly along {goes.axis}" if goes.axis else ""
    with_what = f"{100 * goes.share:.0f} % of its power follows {escape(goes.channel or '')}"
    late = f", {goes.lag:g} s late" if goes.lag else ""
    return (
        f"It is {number(left.rms)} nT RMS, {number(left.white)} nT from one sample to the next, and "
        f"remembers {number(left.correlation_time, 2)} s. "
        + (f"{with_what}{late}{', ' * bool(axis)}{axis}." if goes.channel else "It follows nothing logged.")
    )


def nameless(rest: Leftover, causes: Mapping[str, Cause]) -> str:
    """Say why the rest has no name, and what would tell the possible causes apart."""
    if not rest.within:
        return "It fits no known cause, so it has no name."
    return (
        "No name is asserted: a description without a cause is likelier than any known cause, but by "
        f"less than 20:1 and what a cause's idealised shape may miss. It resembles: {listed(rest.within)}. "
        f"To tell: {escape(causes[rest.within[0].candidate.cause].separated_by)}."
    )


def described(rest: Leftover) -> str:
    """Return what is left as a sentence without its full stop, as HTML."""
    goes = f"; it follows <code>{escape(rest.best_channel)}</code> best" if rest.best_channel else ""
    period = f" of period {rest.period_s:.4g} s" if rest.period_s else ""
    size = f"signal-to-noise ratio {rest.signal_to_noise:.1f}"
    return f"<b>{KINDS[rest.kind]}</b>{period} is left ({size}{goes})"


def _budget(diagnosis: Diagnosis) -> list[str]:
    """Compare the residual that the calibration predicts with those that were found."""
    found, parts = diagnosis.assessment.budget, diagnosis.problem.survey.parts
    rows = {
        "predicted by the calibration as given: noise and its own uncertainty": found.predicted,
        "found with the calibration as given": found.before,
        f"found with the extended calibration, on {parts} left out of its fit": found.after,
        "left in the fit to the whole log": found.fitted,
    }
    lines = (
        f'<tr><td>{name}</td><td class="n">{number(size)} nT</td></tr>'
        for name, size in rows.items()
        if size is not None
    )
    after = found.after or 0.0
    worse = (
        f"<p>What was left out is predicted {number(after / found.fitted, 2)} times worse than what was "
        "fitted: this log determines some of the new terms badly, or they act differently from part to "
        "part.</p>"
    )
    apart = after > WORSE * found.fitted
    return [table(("difference between measured and simulated", "RMS"), lines), worse if apart else ""]


def _noise(diagnosis: Diagnosis) -> str:
    noise = diagnosis.fit.noise
    tails = (
        "Gaussian"
        if noise.nu > 1e5
        else f"with more large values than a Gaussian has (Student's t, {noise.nu:g} degrees of freedom)"
    )
    samples = len(noise.scale)
    correlation = (
        f"correlated in time, so that {samples} samples determine a constant as well as "
        f"{noise.independent:.0f} independent ones would"
        if noise.independent < 0.95 * samples
        else "practically uncorrelated in time"
    )
    return (
        f"The remaining noise: {number(float(np.median(noise.scale)))} nT per sample, {tails}; {correlation}."
        f" The calibration states {number(diagnosis.problem.calibration.noise.sensor)} nT."
    )
