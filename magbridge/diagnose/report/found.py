"""The page's section on what was found, and why it is believed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

from magbridge.arrays import FloatArray
from magbridge.calibration.residual import rms
from magbridge.diagnose.assessment.notes import Note
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.report import figures_of_causes
from magbridge.diagnose.report.decision import paragraph
from magbridge.diagnose.report.findings import parameters
from magbridge.diagnose.report.glossary import legend
from magbridge.diagnose.report.words import MANY, bold, chance, figure, listed, number, physics, row, table

__all__ = ["found", "overview"]

UNITS = (
    '<p class="faint">RMS: root of the mean square. Signal-to-noise ratio (S/N): the size of an effect over '
    "the whole log in units of the noise, less the part that the calibration could imitate; what has 8 is "
    "practically always found. Held out: on parts of the log that were left out of the fit. Or possibly: "
    "causes that explain the data nearly as well.</p>"
)
SURE = 3.0
"""Multiple of its sigma below which a size is vague."""
SYMBOLS = (
    "The corrected field is <code>A (H - T)</code>, with H the reading of the channels; a cause adds to T or "
    "to A as its formula says, with the numbers b of its table. t is the time, p the position of a mass, "
    "theta_2 a temperature after its lag."
)


def found(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Return the section on what was found: each cause, and isolated wrong samples.

    Parameters
    ----------
    diagnosis : Diagnosis
        What is told.
    causes : mapping
        The table of causes that were asked about.
    """
    if not diagnosis.findings and diagnosis.wrong is None:
        if diagnosis.unexplained is not None:
            return ["<p>An effect is present, but no name is asserted: see what is left.</p>"]
        rate = "It is set so that of 100 logs with nothing to find, one gives a false alarm."
        return [f"<p>No cause passes the test. {rate}</p>"]
    parts = []
    if diagnosis.findings:
        names = [name for one in diagnosis.findings for name in parameters(one, len(diagnosis.problem))]
        explained = legend(names)
        parts = [
            figure(
                figures_of_causes.terms(diagnosis),
                "What each cause adds to the total field: does the blue line run through the dots?",
                "Dots: what is measured once everything else is taken out of it.",
            ),
            f'<p class="faint">{SYMBOLS}{f" In the tables, {explained}." if explained else ""}</p>',
        ]
    for k, finding in enumerate(diagnosis.findings):
        parts += [f'<h3 id="cause{k}">{bold(finding.candidate)}</h3>']
        parts += _cause(diagnosis, finding, causes[finding.candidate.cause], diagnosis.assessment.notes[k])
    if diagnosis.wrong is not None:
        parts.append(_outliers(diagnosis.problem.survey.time[diagnosis.wrong.rows]))
    return parts


def overview(diagnosis: Diagnosis) -> str:
    """Return a table with a row for each named cause, and what its numbers mean; empty if there is none."""
    rows = []
    for k, one in enumerate(diagnosis.findings):
        size = rms(one.field(diagnosis.problem))
        rows.append(
            f'<tr><td><a href="#cause{k}">{bold(one.candidate)}</a><br>'
            f'<span class="faint">{escape(diagnosis.causes[one.candidate.cause].meaning)}</span></td>'
            f'<td class="n">{number(size)} nT</td><td class="n">{one.signal_to_noise:.1f}</td>'
            f'<td class="n">× {1 / max(one.gain.ratio, 1e-9):.2f}</td><td>{listed(one.rivals)}</td></tr>'
        )
    heads = ("cause", "its field, RMS", "S/N", "held-out RMS without it", "or possibly")
    return table(heads, rows) + UNITS * bool(rows)


def _cause(diagnosis: Diagnosis, finding: Finding, cause: Cause, known: Sequence[Note]) -> list[str]:
    """Tell of one cause: its physics, the evidence, its numbers, and what is `known` of it."""
    gain, numbers = finding.gain, parameters(finding, len(diagnosis.problem))
    terms = table(("term", "value", "1 sigma", "unit"), (row(name, **one) for name, one in numbers.items()))
    return [
        f'<p class="faint">{physics(cause)}</p>',
        (
            f"<p><b>Why it is believed:</b> its signal-to-noise ratio is {finding.signal_to_noise:.1f}. The "
            "chance that noise alone would make any of the causes tried look this strong is "
            f"{chance(finding.hypothesis.p_value)}. Without this cause, all else fitted anew, the held-out "
            f"RMS is {1 / max(gain.ratio, 1e-9):.2f} times as large (95 %: "
            f"{1 / max(gain.interval[1], 1e-9):.2f} to {1 / max(gain.interval[0], 1e-9):.2f}).</p>"
        ),
        _folded(terms, numbers),
        _vague(numbers),
        *(paragraph(note) for note in known),
    ]


def _vague(numbers: Mapping[str, Mapping[str, Any]]) -> str:
    """Say so where a cause is surely there, but its size is not known."""
    size = numbers.get("rms")
    if not size or size["value"] > SURE * size["sigma"]:
        return ""
    return (
        "<p>That it is there is surer than how large it is: the calibration's own terms, or another cause, "
        "can take over part of it.</p>"
    )


def _outliers(time: FloatArray) -> str:
    """Say how many samples are wrong, and when: `time` (k,) in s since 1970."""
    when = ", ".join(datetime.fromtimestamp(float(t), UTC).strftime("%H:%M:%S") for t in time[:MANY])
    wrong = "1 isolated sample is wrong" if time.size == 1 else f"{time.size} isolated samples are wrong"
    first = f"the first {MANY} " if time.size > MANY else ""
    left = "it" if time.size == 1 else "them"
    return (
        f"<h3><b>outliers</b></h3><p>{wrong}, {first}at {when} UTC. No RMS before or after counts {left}.</p>"
    )


def _folded(terms: str, numbers: Mapping[str, Mapping[str, Any]]) -> str:
    """Fold a table that is too long to be read line by line: its terms count together, few by themselves."""
    if len(numbers) <= MANY:
        return terms
    clear = sum(abs(one["value"]) > 2.0 * one["sigma"] for one in numbers.values() if one["sigma"])
    return (
        f"<details><summary>{len(numbers)} terms, {clear} of them beyond 2 sigma</summary>{terms}</details>"
    )
