"""The page's sections on what is not known, and on what such a log can show at all."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from math import isfinite

from magbridge.diagnose.causes import Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.inference.isolability import CONFOUNDED, LARGEST, Visible
from magbridge.diagnose.report import figures_of_causes
from magbridge.diagnose.report.glossary import TRIALS
from magbridge.diagnose.report.words import figure, label, number, sizes, table

__all__ = ["unknown", "visible"]

ALIKE = 4
"""Causes listed that look like one; the figure shows all."""


def unknown(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> list[str]:
    """Say plainly what this diagnosis does not know; `causes` is the table that was asked about."""
    names = {
        "Whether the true cause is in the table.": f"A name is the likeliest of {len(causes)} known causes. "
        f"{TRIALS}.",
        "What is smaller than this log can show.": "The last section gives the size from which on each cause "
        "would have been found; below it, any of them may be there.",
        "What was not flown.": f"{_ranges(diagnosis)} Beyond that, and on another day or in another place, "
        "nothing was measured.",
        "How good the reference is.": "It is taken for the true field. Where it is wrong in a way that "
        "follows the vehicle, the calibration is bent to it.",
        "What could not be tested here,": _untestable(diagnosis),
    }
    items = (f"<li><b>{head}</b> {text}</li>" for head, text in names.items() if text)
    return [f"<ul>{''.join(items)}</ul>"]


def _untestable(diagnosis: Diagnosis) -> str:
    missing = diagnosis.isolability.untestable.items()
    said = "; ".join(f"{label(name, None)}: {escape(needs)}" for name, needs in missing)
    return f"with what it would take: {said}." if said else ""


def _ranges(diagnosis: Diagnosis) -> str:
    """Say where the calibration's parameters, and what the named causes follow, were in this log."""
    survey = diagnosis.problem.survey
    wanted = [parameter.name for parameter in diagnosis.problem.calibration.parameters]
    wanted += [one.channel for one in diagnosis.named if one.channel]
    seen = []
    for name in dict.fromkeys(name for name in wanted if name in survey.channels):
        channel = survey.channels[name]
        low, high = map(number, channel.extent)
        seen.append(f"{escape(name)} was between {low} and {high} {escape(channel.unit)}".rstrip())
    return f"In this log {', '.join(seen)}." if seen else "This log is one deployment."


def visible(diagnosis: Diagnosis) -> list[str]:
    """Say how large each cause must be to be found in such a log, and which look like it."""
    report = diagnosis.isolability
    named = {finding.candidate.group for finding in diagnosis.findings}
    hidden = [one for one in report.visible if not any(isfinite(size) for size, _ in one.sizes.values())]
    heads = ("cause", "S/N found in 95 %", "smallest size found in 95 %", "looks like")
    rows = (
        f"<tr><td>{_marked(one, named)}</td>"
        f'<td class="n">{one.sure:.1f}</td><td>{sizes(one.sizes)}</td>'
        f"<td>{_twins(diagnosis, one)}</td></tr>"
        for one in report.visible
        if one not in hidden
    )
    unseen = ", ".join(escape(label(one.cause, one.channel)) for one in hidden)
    return [
        (
            "<p>Computed from telemetry, attitude and noise, whatever was measured: how large each effect "
            "must be to be found in 95 of 100 such logs, and which other causes leave nearly the same trace "
            f"(likeness above {100 * CONFOUNDED:.0f} %; such pairs are easily taken for each other)."
            f"{' Bold: found here.' if named else ''}</p>"
        ),
        table(heads, rows),
        f"<p>Not to be found at any plausible size, at most {LARGEST:.0f} times the usual: {unseen}.</p>"
        if unseen
        else "",
        figure(
            figures_of_causes.likeness(diagnosis),
            "Which causes look alike in this log?",
            "Dark: they leave the same trace, once the calibration may adapt. White dot: likeness above "
            f"{100 * CONFOUNDED:.0f} %.",
        ),
    ]


def _marked(one: Visible, named: set[tuple[str, str | None]]) -> str:
    text = escape(label(one.cause, one.channel))
    return f"<b>{text}</b>" if (one.cause, one.channel) in named else text


def _twins(diagnosis: Diagnosis, one: Visible) -> str:
    """List the causes that look most like `one`, the likest first."""
    alike = [(b if a is one else a, rho) for a, b, rho in diagnosis.isolability.pairs if one is a or one is b]
    listed = [
        f"{escape(label(other.cause, other.channel))} {100 * rho:.0f} %" for other, rho in alike[:ALIKE]
    ]
    return ", ".join(listed) + (f", and {len(alike) - ALIKE} more" if len(alike) > ALIKE else "")
