"""Test the sentences of the report, the findings and the page."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from posed import candidate, right
from reported import page_of, section

from magbridge.cli.diagnose import causes_of, summary
from magbridge.diagnose.assessment import (
    Assessment,
    assess,
    level,
    not_separated,
)
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import GridPoint
from magbridge.diagnose.diagnosis import Diagnosis, Finding, measured, small, verdict_of
from magbridge.diagnose.evidence import Hypothesis
from magbridge.diagnose.joint import Improvement
from magbridge.diagnose.leftover import Leftover
from magbridge.diagnose.problem import isotropic
from magbridge.diagnose.report.findings import FINDINGS_FORMAT, findings_json, parameters
from magbridge.diagnose.report.page import chance, marked_up
from magbridge.diagnose.search import Outliers
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import number, write_text


@pytest.mark.parametrize("cause", CAUSES)
def test_a_causes_physics_is_a_sentence(cause: str) -> None:
    """One sentence of prose and formulas, without the markup of a docstring."""
    line = marked_up(CAUSES[cause].physics)
    assert line.endswith(".")
    assert "`" not in line
    assert ":mod:" not in line


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (431.1, 173.0, "430 ± 170"),
        (-1330.2, 22.4, "\N{MINUS SIGN}1330 ± 22"),
        (1.342, 1.44, "1.3 ± 1.4"),
        (0.01234567, 0.00012, "0.01235 ± 0.00012"),
        (12.0, 0.96, "12.00 ± 0.96"),
        (1e5, 1234.0, "100000 ± 1200"),
        (-3.2, 100.0, "0 ± 100"),
    ],
)
def test_a_number_is_written_to_two_digits_of_its_sigma(value: float, sigma: float, text: str) -> None:
    assert f"{measured(value, sigma)} ± {measured(sigma, sigma)}" == text


@pytest.mark.parametrize(
    ("p_value", "text"),
    [(0.5, "0.5"), (0.00231, "0.002"), (3.4e-8, "3·10⁻⁸"), (9.7e-10, "1·10⁻⁹"), (0.0, "below 1·10⁻⁹⁹")],
)
def test_a_chance_is_written_to_one_digit(p_value: float, text: str) -> None:
    assert chance(p_value) == text


SEEN = {"channel": "battpos", "lag_s": 2.0, "axis": "z"}
CLOCK = {"cause": "clock_offset", "channel": None, "signal_to_noise": 9.04, "follows": SEEN}
CURRENT = {"cause": "current_field", "channel": "pitch_current"}


def test_the_command_names_every_cause_that_may_be_it_on_a_line_of_its_own() -> None:
    rest = {"kind": "drift", "signal_to_noise": 7.04, "alternatives": [CLOCK, CURRENT]}
    rest |= {"follows": SEEN | {"channel": None}, "correlation_time_s": 112.3, "rms_nT": 19.96}
    found = {"verdict": "explained", "findings": [CLOCK | {"alternatives": [CURRENT]}], "unexplained": None}
    line = "clock_offset, S/N 9.0, follows battpos 2 s late along z; or current_field (pitch_current)"
    walks = [{"code": "random_walk"}]
    for notes, expected in (([], line), (walks, f"{line} or noise that wanders")):
        assert causes_of(found | {"assessment": {"warnings": [notes]}}) == [expected]
    nameless = {"verdict": "unexplained", "findings": [], "unexplained": rest}
    for white, lasts in ((3.0, "lasts 112 s, "), (21.6, "")):
        known = {"assessment": {"warnings": [], "residual": {"rms_nT": 21.71, "white_nT": white}}}
        (line,) = causes_of(nameless | known)
        assert line.startswith(f"left without a name: drift, S/N 7.0, 20.0 of 21.7 nT RMS, {lasts}along z; ")
        assert line.endswith("resembles clock_offset, current_field (pitch_current)")
    nothing = nameless | known | {"unexplained": None, "verdict": "nothing_found"}
    assert causes_of(nothing) == ["no cause"]


def test_the_command_reports_what_the_improvement_was_measured_on() -> None:
    """The command reports no improvement if no cause was added: 1.14 -> 1.14 nT would look like a failure."""
    use = {"fit_for_use": "conditional", "summary": "Fit for use on one condition: x."}
    facts: dict[str, Any] = {
        "verdict": "explained", "findings": [CLOCK | {"alternatives": [], "follows": None}],
        "unexplained": None, "scalar": [], "rms_before_nT": 117.42, "rms_after_nT": 74.42,
        "improvement": {"interval": [0.486, 0.84], "refit_nT": 101.2},
        "assessment": use | {"reason": "one_condition", "warnings": [[{"code": "no_improvement"}]]},
    }  # fmt: skip
    first, *others = summary(facts, "dives").splitlines()
    assert first == (
        "explained: error of the corrected field 117 -> 74.4 nT RMS, on dives left out of the fit (0.49 to "
        "0.84 times, 95 %); 101 nT by a refit of the calibration alone"
    )
    assert others == [
        "  fit for use: conditional. Fit for use on one condition: x.",
        "  clock_offset, S/N 9.0; no improvement is shown",
    ]
    weak = facts | {"improvement": {"interval": [0.9, 1.02], "refit_nT": 101.2}}
    assert "nT RMS, not held out (0.90 to 1.02 times, 95 %): no improvement is shown" in summary(weak, "")
    plain = facts | {"verdict": "nothing_found", "findings": []}
    plain |= {"assessment": facts["assessment"] | {"reason": "nothing_added"}}
    output = summary(plain, "dives")
    assert output.startswith("nothing_found: 117 nT RMS; nothing is added to the calibration")


def test_a_constant_of_the_reference_is_one_at_any_attitude() -> None:
    """The constant is independent of the scales, which differ between the sensor's channels."""
    problem = replace(right(100), reference_jacobian=np.linspace(0.9, 1.1, 100))
    bias = CAUSES["reference_bias"].candidates(problem)[0]
    named = Hypothesis(bias, ratio=25.0, evidence=9.0, p_value=1e-3, fit=None)
    finding = Finding(named, (), Improvement(2.0, 1.0, 0.5, (0.4, 0.6)), np.array([0.5]), np.eye(1))
    np.testing.assert_allclose(finding.field(problem), 0.5 * bias.width[0])


def test_names_that_gain_nothing_explain_only_in_part() -> None:
    """An example is a survey diagnosed with the calibration that was fitted to it."""
    candidate = CAUSES["reference_bias"].candidates(right(100))[0]
    named = [Hypothesis(candidate, ratio=25.0, evidence=9.0, p_value=1e-3, fit=None)]
    improvements = [Improvement(588.1, 587.3, 0.999, (0.863, upper)) for upper in (1.021, 0.999)]
    assert [verdict_of(named, None, None, one) for one in improvements] == [
        "partly_explained",
        "explained",
    ]
    assert verdict_of([], None, None, improvements[0]) == "nothing_found"


def test_where_the_calibrations_own_numbers_do_as_well_nothing_needs_explaining() -> None:
    """Unless something larger is left without a name (a part of 14 % is a hundredth of the RMS), or slow."""
    problem, noise = right(1000), 10.0 * np.random.default_rng(2).normal(size=1000)
    rest = Leftover("drift", 9.0, 1e-9, 12.0, None, None)
    assert small(problem, noise, None)
    assert [small(problem, noise, rest._replace(size=size)) for size in (1.0, 3.0, None)] == [
        True,
        False,
        False,
    ]
    assert not small(problem, noise + 20.0 * (np.arange(1000) > 500), None)


def test_a_shift_of_the_whole_field_with_a_wrong_reference_is_reported() -> None:
    """A constant may belong to either; with a true reference it is the vehicle's."""
    problem = right(100)
    grown = problem.calibration.coefficients + np.repeat([20.0, 0.0], [3, 6])
    louder = replace(problem.calibration, coefficients=grown)
    bias, order = (CAUSES[cause].candidates(problem)[0] for cause in ("reference_bias", "actuator_order"))
    assert level(problem, [order, bias], louder) == pytest.approx((20.0, 0.1), abs=0.05)
    s = isotropic(louder)
    charted = replace(problem.calibration, covariance=louder.covariance + 30.0**2 * np.outer(s, s))
    assert level(problem, [order, bias], charted) == pytest.approx((0.0, 30.0), abs=0.05)
    named = Hypothesis(order, ratio=25.0, evidence=9.0, p_value=1e-3, fit=None)
    alone = Finding(named, (), Improvement(2.0, 1.0, 0.5, (0.4, 0.6)), np.array([0.5]), np.eye(1))
    contested = replace(alone, competing=(CompetingHypothesis(bias, behind=3.0),))
    assert level(problem, contested.possible, louder) == level(problem, [order, bias], louder)
    assert level(problem, alone.possible, louder) is None
    assert level(problem, [bias], problem.calibration) is None


# ---- ``findings.json`` against its published schema, and the assessment in it against the report ---------


SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "findings.schema.json").read_text(encoding="utf-8"))


def test_a_rival_on_another_channel_is_the_same_cause() -> None:
    """A second thermometer that fits as well does not weaken the name."""
    own, twin, other = (
        candidate(cause, np.ones(1), channel=channel)
        for cause, channel in (
            ("temperature_offset", "hull"), ("temperature_offset", "water"), ("offset_drift", None)
        )
    )  # fmt: skip
    cause = CAUSES["temperature_offset"]
    alone, channels, causes = (
        not_separated(own, cause, [CompetingHypothesis(one, 1.0) for one in competing]).text
        for competing in ([], [twin], [twin, other])
    )
    assert "water would do nearly as well" in channels
    for output in (alone, channels):
        assert "none comes within odds of 20:1" in output
    assert "cannot distinguish it from temperature offset (water) or offset drift (" in causes
    assert cause.disambiguation in causes


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


@pytest.mark.parametrize("name", ["named", "contested", "nothing", "rest"])
def test_the_report_says_what_the_assessment_holds(clear: Diagnosis, name: str) -> None:
    """The report holds the summary, each reason and each note; the summary precedes the first section."""
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


# ---- The page: its first screen with the decision, its unknown parts and its figures -----------------------


def answer(diagnosis: Diagnosis) -> Assessment:
    return assess(diagnosis).assessment


def reasons(found: Assessment) -> list[str]:
    return [note.text for note in (*found.reasons_for, *found.reasons_against)]


def with_(diagnosis: Diagnosis, **more: object) -> Diagnosis:
    """Return the diagnosis with its one finding changed."""
    return replace(diagnosis, findings=(replace(diagnosis.findings[0], **more),))  # type: ignore[arg-type]


IDLE = Improvement(1.0, 1.0, 1.0, (0.9, 1.1))


def test_a_clear_case_is_fit_for_use_on_one_condition(clear: Diagnosis) -> None:
    """The parts left out are of the same log, so a log of another day is the condition."""
    found = answer(clear)
    assert (found.fit_for_use, found.reason) == ("conditional", "one_condition")
    assert "another day" in found.condition
    assert "corrects for what belongs to the vehicle" in reasons(found)[0]
    assert [note.code for note in found.reasons_against] == ["domain", "same_log"]


def test_only_another_day_makes_it_an_unconditional_yes(clear: Diagnosis) -> None:
    shown = Improvement(2.0, 1.0, 0.5, (0.4, 0.6))
    assert answer(replace(clear, other_day=shown)).fit_for_use == "yes"
    assert answer(replace(clear, other_day=IDLE)).fit_for_use == "conditional"


def test_without_an_improvement_of_the_corrected_field_it_is_not_fit_for_use(clear: Diagnosis) -> None:
    found = answer(replace(clear, improvement=IDLE))
    assert (found.fit_for_use, found.reason) == ("no", "no_improvement")
    assert "do not use it" in reasons(found)[0]
    assert answer(replace(clear, over_refit=IDLE)).reason == "refit_as_good"
    refused = answer(replace(clear, refused="not_linear", refusal_values=(22.1, 954.0)))
    assert (refused.fit_for_use, refused.reason) == ("no", "refused")
    assert "predicts an error of 22.1 nT RMS, and the corrector leaves 954 nT" in refused.summary


def test_what_makes_no_difference_needs_no_extension(clear: Diagnosis) -> None:
    """A calibration whose data do not support it sets the condition."""
    small = replace(clear, negligible=True)
    assert answer(small).reason == "not_needed"
    assert "Nothing needs explaining: the causes found make" in page_of(small).partition("<h2")[0]
    given = replace(clear.problem.calibration, warnings=("all headings lie within 20 degrees",))
    found = answer(replace(clear, problem=replace(clear.problem, calibration=given)))
    assert found.fit_for_use == "conditional"
    assert "own data do not support it: all headings lie within 20 degrees." in "".join(reasons(found))
    assert "calibrate again" in found.condition
    removed = clear.improvement._replace(before=1.0, after=0.9)
    weak = replace(clear, problem=replace(clear.problem, calibration=given), improvement=removed)
    assert (answer(weak).fit_for_use, answer(weak).reason) == ("no", "within_sigma")


def test_another_possible_cause_sets_a_condition_that_a_manoeuvre_removes(clear: Diagnosis) -> None:
    """Another channel of the same cause does not: the name holds."""
    other = CompetingHypothesis(candidate("offset_drift", np.ones(1)), 1.0)
    twin = CompetingHypothesis(candidate("current_field", np.ones(1), channel="amps_c"), 1.0)
    found = answer(with_(clear, competing=(other,)))
    assert found.fit_for_use == "conditional"
    assert CAUSES["current_field"].disambiguation in found.condition
    assert "another day" in answer(with_(clear, competing=(twin,))).condition


def test_causes_that_cancel_set_a_condition(clear: Diagnosis) -> None:
    first = clear.findings[0]
    against = replace(first, coefficients=-0.9 * first.coefficients)
    found = answer(replace(clear, findings=(first, against)))
    assert "largely cancel" in found.condition
    assert sum("largely cancel each other" in reason for reason in reasons(found)) == 1
    assert "another day" in answer(replace(clear, findings=(first, first))).condition


def test_each_other_objection_is_reported(clear: Diagnosis) -> None:
    large = 10.0 * np.ones(3)
    survey = clear.problem.survey
    own = replace(clear.problem, survey=replace(survey, fitted=np.ones(len(survey), bool)))
    rest = Leftover("tone", 9.0, 1e-9, 12.0, 33.0, None)
    doubtful = {
        "shows no improvement on held-out parts": with_(clear, improvement=IDLE),
        "10 times the usual size": with_(clear, coefficients=large),
        write_text("own_log"): replace(clear, problem=own),
        "S/N 9.0 is left that has no name": replace(clear, unexplained=rest),
    }
    for text, diagnosis in doubtful.items():
        found = answer(diagnosis)
        assert found.fit_for_use == "conditional"
        assert any(text in reason for reason in reasons(found)), text


def test_a_cause_that_cannot_be_seen_has_no_row(clear: Diagnosis) -> None:
    """The sizes of an undetectable cause would all be infinite."""
    report = clear.isolability
    gone = report.visible[0]._replace(sizes={"x": (np.inf, "nT")})
    blind = replace(clear, isolability=replace(report, visible=(gone, *report.visible[1:])))
    part, whole = (section(one, "What this log could have shown") for one in (blind, clear))
    assert part.count("<tr><td>") == len(report.visible) - 1
    assert "Not to be found at any plausible size" in part
    assert "Not to be found at any plausible size" not in whole


def test_what_has_no_name_is_described_on_the_first_screen(clear: Diagnosis) -> None:
    rest = Leftover("tone", 9.0, 1e-9, 12.0, 33.0, "amps<b>")
    page = page_of(replace(clear, findings=(), unexplained=rest, verdict="unexplained"))
    first, below = page.split("<h2", 1)
    assert "<b>A tone</b> of period 33 s is left (signal-to-noise ratio 9.0; best described by" in first
    assert "amps&lt;b&gt;" in first
    residual = answer(clear).residual
    last = number(residual.correlation_time, 2)
    lasts = f", which last {last} s" * residual.lasts
    assert f"in all {number(residual.rms)}\N{NO-BREAK SPACE}nT RMS{lasts})" in first
    assert f"None of {len(CAUSES)} causes is named." in below


def test_the_page_is_whole(clear: Diagnosis) -> None:
    """Every figure has a caption, and no line ends between a number and its unit."""
    page = page_of(clear, drawn=True)
    assert page.count("<figure>") == page.count("<figcaption>") == page.count('alt="')
    assert page.index('class="box doubt"') < page.index("<h2")
    assert not re.search(r"\d (nT|%)", re.sub(r"base64,[^\"]*|<style>.*?</style>", "", page, flags=re.DOTALL))


def test_the_answer_is_read_in_a_minute(clear: Diagnosis) -> None:
    """Unfolded, the page is a screen: at most 250 words and one figure."""
    first = page_of(clear, drawn=True).partition("<details")[0].partition("<body>")[2]
    assert first.count("<figure>") == 1
    assert len(re.sub(r"<[^>]*>", " ", first).split()) <= 250


def test_the_page_is_small_enough_to_send(clear: Diagnosis) -> None:
    """Even with eight causes: each picture has a palette (colour type 3 in a PNG's header)."""
    page = page_of(replace(clear, findings=clear.findings * 8), drawn=True)
    pictures = [b64decode(text) for text in re.findall(r'base64,([^"]*)', page)]
    assert {picture[25] for picture in pictures} == {3}
    assert len(page) < 800_000


def test_terms_have_a_sigma_and_an_onset_is_a_date(clear: Diagnosis) -> None:
    first = clear.findings[0]
    point = GridPoint({"onset": (1780314641.5, "s")})
    named = replace(first.hypothesis, candidate=replace(first.candidate, point=point))
    output = section(with_(clear, hypothesis=named), "Each cause")
    assert '<tr><td>onset</td><td class="n">2026-06-01 11:50:41</td><td class="n"></td><td>UTC</td>' in output
    x = parameters(first, len(clear.problem))["x"]
    assert f'<td class="n">± {measured(x["sigma"], x["sigma"])}</td><td>nT/A</td>' in output


def test_the_times_of_wrong_samples_are_all_or_the_first(clear: Diagnosis) -> None:
    time = 1780300800.0 + np.arange(float(len(clear.problem.survey)))
    problem = replace(clear.problem, survey=replace(clear.problem.survey, time=time))

    def output(count: int) -> str:
        wrong = Outliers(np.arange(count), 40.0, 1e-6, 1.0, lasting=False)
        return section(replace(clear, problem=problem, wrong=wrong), "Each cause")

    assert "1 isolated sample is wrong, at 08:00:00 UTC. No RMS before or after counts them." in output(1)
    assert "2 isolated samples are wrong, at 08:00:00, 08:00:01 UTC." in output(2)
    assert "13 isolated samples are wrong, the first 12 at 08:00:00, " in output(13)
