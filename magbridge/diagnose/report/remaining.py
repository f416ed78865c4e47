"""The page's section on what is left: the residual that was predicted, and the one that remains."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from magbridge.calibration.residual import rms
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis, counted
from magbridge.diagnose.report.doubts import nameless
from magbridge.diagnose.report.words import number, table
from magbridge.diagnose.unexplained.leftover import Leftover

__all__ = ["described", "remaining"]

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
        return "<p>No further structure was found: no slow curve, no steps, no function of attitude.</p>"
    return f"<p>{described(rest)}. {nameless(rest, causes)}</p>"


def described(rest: Leftover) -> str:
    """Return what is left as a sentence without its full stop, as HTML."""
    goes = f"; it follows <code>{escape(rest.best_channel)}</code> best" if rest.best_channel else ""
    period = f" of period {rest.period_s:.4g} s" if rest.period_s else ""
    size = f"signal-to-noise ratio {rest.signal_to_noise:.1f}"
    return f"<b>{KINDS[rest.kind]}</b>{period} is left ({size}{goes})"


def _budget(diagnosis: Diagnosis) -> list[str]:
    """Compare the residual that the calibration predicts with those that were found."""
    total, parts = diagnosis.total, diagnosis.problem.survey.parts
    counts = counted(diagnosis.problem, diagnosis.wrong)
    fitted = rms(diagnosis.fit.left[counts])
    extended = f"found with the extended calibration, on {parts} left out of its fit"
    rows = {
        "predicted by the calibration as given: noise and its own uncertainty": float(
            np.sqrt(np.mean(diagnosis.problem.stated[counts]))
        ),
        "found with the calibration as given": total.before,
        **({extended: total.after} if diagnosis.findings else {}),
        "left in the fit to the whole log": fitted,
    }
    lines = (f'<tr><td>{name}</td><td class="n">{number(size)} nT</td></tr>' for name, size in rows.items())
    worse = (
        f"<p>What was left out is predicted {number(total.after / fitted, 2)} times worse than what was "
        "fitted: this log determines some of the new terms badly, or they act differently from part to "
        "part.</p>"
    )
    apart = diagnosis.findings and total.after > WORSE * fitted
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
