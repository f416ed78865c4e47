"""The texts of a diagnosis: a template for each code of a note, a refusal, a condition or a verdict.

Everything else in the package returns codes with values. The format of a number in a template is its number
of significant digits; ``%`` writes a fraction in per cent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import floor, isfinite, log10
from operator import itemgetter
from string import Formatter
from typing import Any, NamedTuple

from magbridge.diagnose.columns import Candidate

SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_UNFOLDED_NUMBERS = 12
"""Numbers that a table shows unfolded."""

TEXTS = {
    # Notes on one finding
    "several_terms": "A number in brackets: several such terms were needed to describe the cause; they act "
    "together.",
    "attenuation": "It shortens a field that turns, as an RC filter of {corner_Hz:2} Hz does. The extended "
    "calibration is fitted without that, as with calibrate --filter-cutoff. In turns the corrected field "
    "stays too short.",
    "implausible_amplitude": "This is {times_usual:2} times the usual size of such a cause. Two causes that "
    "cancel each other can grow this large: check the extended calibration against another reference before "
    "it is used.",
    "random_walk": "It may as well be noise: a sensor whose offsets wander (a random walk, of power 1/f^2) "
    "would look the same in this log, within odds of 20:1. To tell: log the sensor at rest for as long.",
    "alone": "No other known cause explains the data nearly as well (none comes within odds of 20:1).",
    "series_uncertain": "No other known cause explains the data nearly as well (none comes within odds of "
    "20:1). Which series it follows is less sure: {series} would do nearly as well (odds below 20:1). A log "
    "in which these differ more would tell.",
    "contested": "The data cannot distinguish it from {others} (odds below 20:1). A correction under a wrong "
    "name may fit this log and fail on the next. To distinguish them: {manoeuvre}.",
    "beside_moving_masses": "{share:%} of its power lies in the {usual:%} of samples next to which a mass "
    "moved. With {interval:.3g} s between rows, a mass that was not where its row says would look the same.",
    "telemetry_delay": "With delay = {delay} in {tables} of bridge.toml the calibration as given leaves "
    "{after_nT:3} nT RMS of {before_nT:3} on this log. Use either the delay or the extended calibration, not "
    "both.",
    "recent": "It is best described as absent from the logs that the calibration was fitted to: it may have "
    "appeared since.",
    "not_live": "It is not in the extended calibration: live, a rate of change is a backward difference, "
    "whose noise would exceed what the correction improves.",
    "no_improvement": "It shows no improvement on held-out parts: it may be a remnant of another effect.",
    "rest_is_stronger": "The unexplained rest is stronger than this cause, and may have caused part of it.",
    # Reasons for and against the use of the extended calibration
    "use": "The extended calibration, calibration.json next to this page, {verdict}.{but}",
    "use.good": "corrects for what belongs to the vehicle and its sensor",
    "use.bad": "shows no improvement on data that it was not fitted to: do not use it before another log "
    "does",
    "use.but": " It leaves {others} in the field, which the RMS above has removed.",
    "of_finding": "{name}: {text}",
    "own_log": "The calibration was fitted to this very log and has absorbed part of its errors: the "
    "improvement is not a test.",
    "unsupported": "The calibration's own data do not support it: {warnings}.",
    "reference_shift": "The extended calibration shifts the whole corrected field by {shift:+.1f} nT, to "
    "within {sigma:.1f} nT (1 sigma, if the names are right). A log cannot tell for sure whether a constant "
    "belongs to the vehicle or to the reference: check the extended field against another reference before "
    "using it.",
    "spatial_temporal": "{track} Only their usual shapes support: {names}.",
    "cancelling": "{one} and {other} largely cancel each other ({one_nT:3} and {other_nT:3} nT RMS, together "
    "{together_nT:3}): outside of the range of this log, their sum may be far off.",
    "unexplained": "Something of S/N {signal_to_noise:.1f} is left that has no name.",
    "domain": "The improvement was measured at {ranges}; nothing is known outside.",
    "same_log": "All parts left out of the fit belong to this log: a log of another day may differ.",
    # Whether place and time are distinguished
    "track.never": "The track never returns to a place: an error of the map and a slow change with time (a "
    "daily variation) cannot be distinguished.",
    "track.separable": "The track passes {share:%} of its places again, up to {hours:.1f} h later: an error "
    "of the map and a slow change with time (a daily variation) can be distinguished.",
    "track.alike": "The track passes {share:%} of its places again, up to {hours:.1f} h later, but at times "
    "at which one imitates {like:%} of the other's power: an error of the map and a slow change with time (a "
    "daily variation) cannot be distinguished.",
    # Whether the extended calibration is fit for use
    "summary.held_out_and_other_day": "The corrected field improves on parts and on days left out of the "
    "fit.",
    "summary.one_condition": "Fit for use on one condition: {condition}",
    "summary.not_needed": "There is no need for it: the calibration's own coefficients, refitted, do as "
    "well.",
    "summary.reference_only": "It has no new term: the error found belongs to the reference, not to the "
    "vehicle. Its coefficients are refitted without that error.",
    "summary.no_improvement": "The corrected field does not improve on held-out parts.",
    "summary.refit_as_good": "A refit of the calibration alone corrects as well: calibrate again instead.",
    "summary.refused": "The extension is refused. {why}. calibration.json is the calibration as it was "
    "given.",
    "summary.holds": "calibration.json is the calibration as it was given. As far as this log can show (last "
    "section), it holds.",
    "summary.nothing_added": "calibration.json is the calibration as it was given. It does not describe all "
    "that this vehicle's sensor sees: expect errors like the {before_nT:3} nT RMS found here.",
    # Why an extension is refused, with the allowed and the found value
    "refusal.not_linear": "On parts left out of the fit the linear model predicts an error of {allowed:3} nT "
    "RMS, and the corrector leaves {found:3} nT",
    "refusal.outside_prior": "It would move the corrected field by {found:3} nT where this log does not "
    "determine it and the calibration allows {allowed:3} nT",
    "refusal.worse": "On parts left out of the fit the calibration as given leaves {allowed:3} nT RMS, and "
    "the extended one up to {found:3} nT (95 %)",
    "refusal.written_file": "The written file, read back, corrects this log with an error of {found:3} nT "
    "RMS, and the calibration as given with one of {allowed:3} nT",
    # The condition that removes each objection, the weightiest first
    "condition.own_log": "compare a log that the calibration was not fitted to.",
    "condition.unsupported": "calibrate again from runs that support the calibration ({warnings}).",
    "condition.contested": "find out first which of the possible causes it is: {manoeuvres}.",
    "condition.random_walk": "log the sensor at rest for as long as this log, to exclude a drifting offset.",
    "condition.implausible_amplitude": "compare the corrected field with another reference, because the "
    "effect is implausibly large.",
    "condition.reference_shift": "compare the corrected field with another reference, because all of it is "
    "shifted.",
    "condition.cancelling": "compare the corrected field with another reference, because two causes largely "
    "cancel.",
    "condition.unexplained": "find the cause of the unexplained residual.",
    "condition.spatial_temporal": "cross the track again at another time, to distinguish a map's error from "
    "a change with time.",
    "condition.no_improvement": "compare another log, because one of the causes shows no improvement of its "
    "own.",
    "condition.same_log": "the improvement must show in a log of another day as well.",
}
CONDITION_CODES = tuple(code.removeprefix("condition.") for code in TEXTS if code.startswith("condition."))
"""Codes of objections that a condition removes, the weightiest first."""


class Diagnostic(NamedTuple):
    """A statement: a code for programs, and the values in its text."""

    code: str
    values: Mapping[str, Any] = {}
    about: str = ""
    """Finding that it is about, where it stands away from that."""

    @property
    def text(self) -> str:
        """Text for people, in plain words."""
        own = write_text(self.code, **self.values)
        return write_text("of_finding", name=self.about, text=own) if self.about else own

    @property
    def numbers(self) -> dict[str, float]:
        """Values that are numbers."""
        return {name: value for name, value in self.values.items() if isinstance(value, float)}


class _Numbers(Formatter):
    """Formatter whose format of a number is its count of significant digits, or ``%``."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text."""
        if format_spec == "%":
            return f"{100.0 * value:.0f} %"
        return number(value, int(format_spec)) if format_spec.isdigit() else format(value, format_spec)


def write_text(code: str, **values: Any) -> str:
    """Return the text of a code with its values."""
    return _Numbers().format(TEXTS[code], **values)


def label(cause: str, channel: str | None) -> str:
    """Return a cause as people read it."""
    return cause.replace("_", " ") + (f" ({channel})" if channel else "")


def names_of(candidates: Sequence[Candidate], joint: str = ", ") -> str:
    """Return causes as a list in words."""
    return joint.join(label(candidate.cause, series_of(candidate)) for candidate in candidates)


def series_of(candidate: Candidate) -> str | None:
    """Return the telemetry that a candidate follows, as people read it; None where it follows none."""
    several = len({channel for effect in candidate.effects for channel in effect.channels()}) > 1
    return "several together" if candidate.channel is None and several else candidate.channel


def number(value: float, digits: int = 3) -> str:
    """Write a number with significant digits and without an exponent: 1070, not 1.07e+03."""
    rounded = float(f"{value:.{digits}g}")
    if not rounded or not isfinite(rounded):
        return f"{rounded:g}"
    places = max(digits - 1 - floor(log10(abs(rounded))), 0)
    return f"{rounded:.{places}f}".replace("-", "\N{MINUS SIGN}")


def measured(value: float, sigma: float | None) -> str:
    """Write a number to the second digit of its sigma; without one (a count, a period), to four digits."""
    if not sigma or not isfinite(sigma):
        return f"{float(f'{value:.4g}'):g}"
    places = 1 - floor(log10(sigma))
    # an added 0 turns a value that was rounded to -0 into 0
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}".replace("-", "\N{MINUS SIGN}")


def chance(p_value: float) -> str:
    """Write a probability to one digit, without a place where a line could break: 0.002, 3·10⁻⁸."""
    if p_value > 1e-4:
        return f"{p_value:.1g}"
    digit, power = f"{max(p_value, 1e-99):.0e}".split("e-")
    return ("" if p_value > 1e-99 else "below ") + f"{digit}·10⁻{power.lstrip('0').translate(SUPERSCRIPTS)}"


def sizes(smallest: Mapping[str, tuple[float, str]]) -> str:
    """Return sizes in words from values and units by name; an infinite one is left out."""
    seen = [(name, size, unit) for name, (size, unit) in smallest.items() if isfinite(size)]
    shown = seen if len(seen) <= MAX_UNFOLDED_NUMBERS else seen[:3]
    texts = [
        ", ".join(f"{name} {number(size)}" for name, size, _ in same) + f" {unit}"
        for unit, same in groupby(shown, key=itemgetter(2))
    ]
    if len(shown) < len(seen):
        texts.append(f"and {len(seen) - len(shown)} more")
    return ", ".join(texts) or "no plausible size reaches it"
