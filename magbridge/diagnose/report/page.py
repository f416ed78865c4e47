"""``report.html``, from the template in this folder, and the files of a diagnosis."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import cache, partial
from itertools import groupby
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from magbridge.calibration.file import encode_calibration
from magbridge.diagnose.assessment import DiagnosisResult, Fitness, separation
from magbridge.diagnose.diagnosis import Diagnosis, label, measured, names_of, series_of
from magbridge.diagnose.evidence import CONFOUNDED, Visible
from magbridge.diagnose.report import figures
from magbridge.diagnose.report.findings import findings_json, parameters
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import number
from magbridge.estimation.residual import rms
from magbridge.files import atomic_path, new_folder
from magbridge.wording import counted

MARKS: dict[Fitness, str] = {"yes": "good", "conditional": "doubt", "no": "none"}
"""CSS class of the verdict's box, by verdict."""
KIND_SUBJECTS = {
    "switching": "Something that switches or comes and goes",
    "drift": "A slow drift",
    "tone": "A tone",
    "transient": "A transient",
    "broadband": "Something broadband",
}
"""Kinds of the unexplained structure, in words that begin a sentence."""
SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_UNFOLDED_NUMBERS = 12
"""Largest number of values that a table shows unfolded."""


def report_html(result: DiagnosisResult, remarks: Sequence[str] = ()) -> str:
    """Return the report page; `remarks` are sentences on the logs, each without its full stop."""
    diagnosis, assessment = result
    content = _environment().get_template("report.html").render(
        d=diagnosis, a=assessment, remarks=remarks, survey=diagnosis.problem.survey,
        calibration=diagnosis.problem.calibration, parts=diagnosis.problem.survey.parts, kinds=KIND_SUBJECTS,
        unfolded=MAX_UNFOLDED_NUMBERS, mark=_mark(result), pictures=_pictures(diagnosis),
        rows=_rows(result), **_log(diagnosis), **_rest(result), **_visible(result),
    )  # fmt: skip
    for unit in (" %", " nT", " UTC"):  # no line ends between a number and its unit
        content = content.replace(unit, f"\N{NO-BREAK SPACE}{unit[1:]}")
    return content


@cache
def _environment() -> Environment:
    """Return the template engine, with the filters of names and numbers."""
    folder = FileSystemLoader(Path(__file__).parent)
    made = Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )
    made.filters |= {
        "number": number, "measured": measured, "chance": chance, "sizes": sizes, "counted": counted,
        "series": series_of, "plain": partial(label, channel=None), "names": _names, "clock": _clock,
        "label": lambda visible: label(visible.cause, visible.channel),
        "inverse": lambda ratio: f"{1.0 / max(ratio, 1e-9):.2f}",
    }  # fmt: skip
    return made


def _names(competing: Sequence[CompetingHypothesis], joint: str = ", ") -> str:
    return names_of([hypothesis.candidate for hypothesis in competing], joint)


def _clock(time: float, form: str) -> str:
    """Return a time, s since 1970 UTC, in the format `form` of strftime."""
    return datetime.fromtimestamp(float(time), UTC).strftime(form)


def _mark(result: DiagnosisResult) -> str:
    """Return the CSS class of the verdict's box."""
    bad = result.assessment.reason in ("refused", "no_improvement", "refit_as_good")
    return "bad" if bad else MARKS[result.assessment.fit_for_use]


def _pictures(diagnosis: Diagnosis) -> dict[str, str | None]:
    """Return each figure of the page by name, as a PNG in base64; None for a figure without data."""
    drawn = figures.measured, figures.terms, figures.channels, figures.spectrum, figures.track
    return {draw.__name__: draw(diagnosis) for draw in drawn}


def _log(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the template's values of the log: its times and counts, and its use by the calibration."""
    survey = diagnosis.problem.survey
    new = ~survey.learned
    time = survey.time[new]
    return {
        "first": float(time[0]), "last": float(time[-1]), "samples": time.size,
        "learned": int(survey.learned.sum()), "own_log": bool((survey.fitted & new).any()),
        "dives": np.unique(survey.dive[new]).size,
        "wrong": [] if diagnosis.wrong is None else survey.time[diagnosis.wrong.rows].tolist(),
    }  # fmt: skip


def _rows(result: DiagnosisResult) -> list[dict[str, Any]]:
    """Return the template's values for each finding."""
    diagnosis, rows = result.diagnosis, []
    for finding, notes in zip(diagnosis.findings, result.assessment.notes, strict=False):
        numbers = parameters(finding, len(diagnosis.problem))
        sure = [abs(one["value"]) > 2.0 * one["sigma"] for one in numbers.values() if one["sigma"]]
        rows.append(
            {
                "finding": finding, "notes": notes, "numbers": numbers, "significant": sum(sure),
                "seen": finding.follows(diagnosis.problem, diagnosis.fit),
                "rms": rms(finding.field(diagnosis.problem)),
                "physics": marked_up(diagnosis.causes[finding.candidate.cause].physics),
            }
        )  # fmt: skip
    return rows


def marked_up(line: str) -> Markup:
    """Return a line of a docstring as HTML, with its formulas as code."""
    parts = str(escape(line)).split("``")
    # formulas are escaped above; the only markup is that of the code
    return Markup("".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts)))  # noqa: S704


def _rest(result: DiagnosisResult) -> dict[str, Any]:
    """Return the template's values of the unexplained structure and of the noise."""
    diagnosis = result.diagnosis
    rest, noise, problem = diagnosis.unexplained, diagnosis.fit.noise, diagnosis.problem
    return {
        "louder": rest and all(rest.signal_to_noise > one.signal_to_noise for one in diagnosis.findings),
        "of_reference": any(candidate.about != "vehicle" for candidate in diagnosis.named),
        "noise_rms": rms(diagnosis.residual),
        "noise": noise,
        "scale": float(np.median(noise.scale)),
        "total": len(noise.scale),
        "slow": rms(problem.slow_noise(diagnosis.fit.z)),
        "shifts": problem.survey.time[list(rest.shifts if rest else ())].tolist(),
    }


def _visible(result: DiagnosisResult) -> dict[str, Any]:
    """Return the causes that the log can show and cannot show, and the causes similar to each."""
    report, track = result.diagnosis.isolability, result.assessment.returns
    hidden = [one for one in report.visible if not any(isfinite(size) for size, _ in one.sizes.values())]

    def alike(visible: Visible) -> list[tuple[Visible, float]]:
        return [(b if a is visible else a, rho) for a, b, rho in report.pairs if visible is a or visible is b]

    return {
        "hidden": hidden, "shown": [one for one in report.visible if one not in hidden], "alike": alike,
        "confounded": CONFOUNDED, "separation": track and separation(track).text,
    }  # fmt: skip


def write(result: DiagnosisResult, out_dir: str | os.PathLike[str], remarks: Sequence[str] = ()) -> None:
    """Write ``findings.json``, ``calibration.json`` and ``report.html``; on a WriteError, none of them."""
    contents = {
        "calibration.json": encode_calibration(result.diagnosis.calibration),
        "findings.json": findings_json(result, remarks),
        "report.html": report_html(result, remarks).encode(),
    }
    with new_folder(out_dir) as folder, ExitStack() as written:
        for name, content in contents.items():
            written.enter_context(atomic_path(folder / name)).write_bytes(content)


def chance(p_value: float) -> str:
    """Return a probability to one digit, without a space: 0.002, 3·10⁻⁸."""
    if p_value > 1e-4:
        return f"{p_value:.1g}"
    digit, power = f"{max(p_value, 1e-99):.0e}".split("e-")
    return ("" if p_value > 1e-99 else "below ") + f"{digit}·10⁻{power.lstrip('0').translate(SUPERSCRIPTS)}"


def sizes(smallest: Mapping[str, tuple[float, str]]) -> str:
    """Return finite sizes in words, from values and units by name."""
    seen = [(name, size, unit) for name, (size, unit) in smallest.items() if isfinite(size)]
    shown = seen if len(seen) <= MAX_UNFOLDED_NUMBERS else seen[:3]
    texts = [
        ", ".join(f"{name} {number(size)}" for name, size, _ in same) + f" {unit}"
        for unit, same in groupby(shown, key=itemgetter(2))
    ]
    if len(shown) < len(seen):
        texts.append(f"and {len(seen) - len(shown)} more")
    return ", ".join(texts) or "no plausible size reaches it"
