"""Test the report page: its first screen with the decision, its unknown parts and its figures."""

from __future__ import annotations

import re
from base64 import b64decode
from dataclasses import replace

import numpy as np
from posed import candidate
from reported import page_of, section

from magbridge.diagnose.assessment import Assessment, assess
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.columns import GridPoint
from magbridge.diagnose.diagnosis import Diagnosis, measured
from magbridge.diagnose.joint import Improvement
from magbridge.diagnose.leftover import Leftover
from magbridge.diagnose.report.findings import parameters
from magbridge.diagnose.search import Outliers
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import number, write_text


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


def test_names_that_something_unexplained_keeps_are_listed(clear: Diagnosis) -> None:
    """With the manoeuvre that distinguishes the likeliest of them; what fits no cause has no names."""
    drift, current = (
        CompetingHypothesis(candidate(cause, np.ones(1), channel=channel), behind)
        for cause, channel, behind in (("offset_drift", None, 0.0), ("current_field", "motor<1>", 1.0))
    )
    rest = Leftover("drift", 9.0, 1e-9, 12.0, None, None, within=(drift, current))
    output = section(replace(clear, unexplained=rest), "What is left")
    assert "It resembles: offset drift, current field (motor<1>)." in output
    assert CAUSES["offset_drift"].disambiguation in output
    alone = section(replace(clear, unexplained=rest._replace(within=())), "What is left")
    assert "It fits no known cause, so it has no name." in alone
