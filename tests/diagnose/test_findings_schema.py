"""``findings.json`` against its published schema, and the assessment in it against the report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from posed import candidate
from reported import page_of

from magbridge.diagnose.assessment import assess
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.leftover import Leftover
from magbridge.diagnose.report.findings import FINDINGS_FORMAT, findings_json
from magbridge.diagnose.search import Outliers
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import number

SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "findings.schema.json").read_text(encoding="utf-8"))


def variants(clear: Diagnosis) -> dict[str, Diagnosis]:
    rest = Leftover("tone", 9.0, 1e-9, 12.0, 33.0, "amps")
    competitor = CompetingHypothesis(candidate("offset_drift", np.ones(1)), 1.0)
    contested = replace(clear.findings[0], competing=(competitor,), coefficients=10.0 * np.ones(3))
    return {
        "named": clear,
        "contested": replace(clear, findings=(contested,)),
        "nothing": replace(clear, findings=(), verdict="nothing_found"),
        "rest": replace(clear, unexplained=rest._replace(within=(competitor,)), verdict="partly_explained"),
        "wrong": replace(clear, wrong=Outliers(np.array([3, 90]), 40.0, 1e-6, 1.0, lasting=False)),
    }


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["properties"]["format"]["const"] == FINDINGS_FORMAT


@pytest.mark.parametrize("name", ["named", "contested", "nothing", "rest", "wrong"])
def test_findings_are_as_the_schema_says(clear: Diagnosis, name: str) -> None:
    facts = json.loads(findings_json(assess(variants(clear)[name]), ["a remark"]))
    errors = [error.message for error in Draft202012Validator(SCHEMA).iter_errors(facts)]
    assert errors == []


def test_what_is_not_in_the_schema_is_refused(clear: Diagnosis) -> None:
    facts: dict[str, Any] = json.loads(findings_json(assess(clear)))
    for wrong in (facts | {"more": 1}, facts | {"verdict": "fine"}, facts | {"format": FINDINGS_FORMAT + 1}):
        assert not Draft202012Validator(SCHEMA).is_valid(wrong)


@pytest.mark.parametrize("name", ["named", "contested", "nothing", "rest"])
def test_the_report_says_what_the_assessment_holds(clear: Diagnosis, name: str) -> None:
    """Answer, and each reason and note, word by word; the answer stands before the first section."""
    diagnosis = variants(clear)[name]
    facts = json.loads(findings_json(assess(diagnosis)))["assessment"]
    page = unescape(page_of(diagnosis)).replace("\N{NO-BREAK SPACE}", " ")
    first = page.partition("<h2")[0]
    assert facts["summary"] in first
    for note in (*facts["reasons_for"], *facts["reasons_against"]):
        assert note["text"] in first
    for note in (note for some in facts["warnings"] for note in some):
        assert note["text"] in page
    if name == "contested":
        assert facts["fit_for_use"] == "conditional"
        assert facts["manoeuvres"] == [CAUSES["current_field"].disambiguation]
        assert {"contested", "implausible_amplitude"} <= {note["code"] for note in facts["reasons_against"]}


def test_what_is_seen_stands_apart_from_what_it_may_be(clear: Diagnosis) -> None:
    (one,) = json.loads(findings_json(assess(clear)))["findings"]
    assert one["cause"] == "current_field"
    assert one["follows"]["channel"] == one["channel"]
    assert one["follows"]["amplitude_nT"] > 1.0


def test_no_sentence_says_that_nothing_is_left(clear: Diagnosis) -> None:
    """It says how much is left, how long that remembers unless it is white, and what a refit would do."""
    page, last = page_of(clear), assess(clear).assessment.residual
    assert "Nothing else" not in page
    assert re.search(r"The remaining [\d.]+\xa0nT RMS look like noise", page)
    assert ("remembers" in page) == last.lasts
    assert clear.improvement.after < clear.over_refit.before <= 1.01 * clear.improvement.before
    assert f"A refit of the calibration alone leaves {number(clear.over_refit.before)}\xa0nT" in page
