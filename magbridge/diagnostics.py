"""Diagnostics: messages with a code for programs, values, and a text for people.

Calibration, survey, diagnosis and navigation return codes with values. This module has the text of each code.
In a text, an integer as the format of a number is its count of significant digits; ``%`` writes a fraction in
per cent.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import floor, isfinite, log10
from string import Formatter
from typing import Any, NamedTuple

__all__ = ["CONDITION_CODES", "Diagnostic", "number", "write_text"]

FIT_TEXTS = {
    # Reasons against a fit: without --force they keep it from being written
    "unsupported_fit": "the data do not support this fit: {reasons}",
    "lasting_residual": "residuals of {noise_nT:.0f} nT last for many samples (autocorrelation "
    "{autocorrelation:.3f}) without the crustal field: two vehicles in one log, an offset that jumped, "
    "wrong positions, a current that no --parameter names, or eddy currents near the sensor",
    "expected_error": "at these pitches and positions, on any heading and with 10 degrees more roll, "
    "expect {error_nT:.0f} nT of error",
    "narrow_headings": "all headings lie within {width_deg:.0f} degrees, and on other headings the "
    "vehicle's field cannot be distinguished from the Earth's",
    "unusual_gain": "the readings ask for a gain that is further from 1 than sensors have (so far "
    "{low:.2f} to {high:.2f}), and their attitudes are too few to separate it from the offset: check the "
    "unit and the reference, or fly dives, climbs and banked turns",
    "noise_for_attitudes": "the noise of {noise_nT:.0f} nT is not small against the variation of the field "
    "along one axis ({variation_nT:.0f} nT), so that noise passes for attitudes: average readings, or turn "
    "further",
    "rough_crust": "the crustal field changes over {length_m:.0f} m, less than half the distance between "
    "your tracks (about {spacing_m:.0f} m): it is hardly separated from vehicle and noise, and the map is "
    "uncertain between tracks; fly tracks closer together",
    "shortest_crust": "the crustal field changes over {length_m:.0f} m, the shortest length that these "
    "samples can tell being {shortest_m:.0f} m: it is hardly separated from vehicle and noise, and the map "
    "is uncertain between tracks; fly tracks closer together",
    # What the runs leave undetermined
    "few_positions": "{parameter} was nearly always at {positions} ({places}): elsewhere the correction "
    "rests on the physical model, not on measurements; fly a run with it at another position",
    "moved_together": "{one} and {other} always moved together (correlation {correlation:.2f}): their "
    "effects cannot be distinguished; fly a run that moves only one of them",
    "narrow_roll": "roll stayed within {low:z.0f} to {high:z.0f} degrees: the vertical offset is known "
    "only to {sigma_nT:.0f} nT; fly a run banked the other way",
    "narrow_pitch": "pitch stayed within {low:z.0f} to {high:z.0f} degrees: nothing steeper was measured; "
    "fly dives and climbs",
    "one_pitch_sign": "only {seen} (pitch {low:z.0f} to {high:z.0f}): nothing was measured in {lacking}",
    "heading_gap": "no run headed between {left:03.0f} and {right:03.0f}: fly full turns",
    "few_runs": "only {runs}: too few to validate the fit on runs left out",
    "never_crossed": "you never crossed your own track: only its smoothness separates the crustal field "
    "from heading; fly legs that cross earlier ones at other headings",
    "few_crossings": "you crossed your own track at {places} only: little separates the crustal field from "
    "heading; fly more legs that cross earlier ones",
    "level_of_reference": "the level of the field is the reference's, to {level_nT:.0f} nT: the fit's own, "
    "{bias_nT:+.0f} nT from it, is not plausible (an effect is missing in the model)",
    # Which method answered instead of the one that was asked
    "no_field_in_place": "the crustal field was not found with the calibration: its part stays in the errors",
    "one_ellipsoid": "method auto has no solution, so that one ellipsoid was fitted (method nominal), "
    "without parameters",
    "without_parameters": "method nominal has no solution: used was method auto, without parameters",
    # Headings and the mounting of the sensor
    "no_boresight": "{reason}",
    "magnetic_headings": "the headings look magnetic: with the declination of {declination:+.1f} degrees "
    "added, the sensor is turned by {true_turn:.1f} degrees and not by {turn:.1f}, and {true_left:.1f} not "
    "{left:.1f} are left (--heading-reference magnetic)",
    # Samples that were left out, and what the residuals show
    "outliers": "{count} of {samples} samples are outliers and were left out of the {product}",
    "flagged_samples": "{count} of {samples} samples are flagged and left out: {flags}",
    "ends_left_out": "{samples} at the ends of the log left out: unlike the others (a crash?)",
    "without_position": "{samples} without a position: left out",
    "far_position": "{samples} far from all others (a jump in position): left out",
    "position_jumps": "the position jumps by {step_m:.0f} m ({jumps} of more than {limit_m:.0f} m): a fix "
    "after dead reckoning? --position-sigma bends the track between",
    "temperature_removed": "the sensor's offset follows its temperature by {slope:.1f} nT/degC{late}: the "
    "calibration takes that off, and needs {channel}",
    "offset_crept": "the sensor's offset crept by {rms_nT:.1f} nT (RMS) during the survey: its mean stands "
    "in the calibration, and the sigma counts the rest",
    "held_out_errors": "held-out parts have errors of {ratio:.1f} times the fit's sigma, so its sigmas "
    "were raised by that: an effect is missing in the model (try a higher --order, or magbridge diagnose) or "
    "in the reference",
    "unusual_scales": "the fit multiplies the readings by {low:.2f} to {high:.2f}, and anomalies with "
    "them: unless the sensor is that far off, the reference is; fit to runs at one place, or with a better "
    "map (--grid)",
    # Several logs in one fit
    "unused_log": "{log}: adds no sample to the fit: {reason}",
    "several_vehicles": "one calibration does not fit all logs: {together}, each on its own {fits} nT RMS; "
    "they are of two vehicles, or of one that changed in between (its iron, or a mass that no --parameter "
    "names)",
    # A survey's map
    "no_crossing_lines": "no line crosses another: only the smoothness of the crustal field separates it "
    "from line levels",
    "misties_remain": "crossings differ by {misties_nT:.1f} nT after levelling, at a noise of "
    "{noise_nT:.2f} nT: the map's sigma does not hold{divided}",
    "no_crossing_track": "the track never crosses itself: slow changes with time cannot be distinguished "
    "from the crustal field, and are in the map",
}
"""Texts of a calibration's and of a survey's diagnostics."""

TRACK_TEXTS = {
    "own_track": "field of {amplitude_nT:.0f} nT over {length_m:.0f} m; position 1-sigma {median_m:.0f} m "
    "in the median, {last_m:.0f} m at the end; dead reckoning alone {alone_median_m:.0f} and "
    "{alone_last_m:.0f} m",
    "own_track.bound": "no estimator could be better than {bound_m:.0f} m RMS here, with this track and "
    "this field",
    "own_track.contradiction": "field and track contradict each other (noise of {noise_ratio:.1f} times "
    "what the calibration claims): the calibration or the options for dead reckoning are not good; do not "
    "use it",
    "own_track.too_short": "the field changes over {length_m:.0f} m, and measurements are {apart_m:.0f} m "
    "apart{thinned}: it is hardly followed",
    "own_track.lost": "tracks that differ by more than the field's length agree with it equally well, and "
    "not all are known: this is dead reckoning alone",
    "own_track.ambiguous": "dead reckoning may be off by more than the field's length: the track may be at "
    "another repetition of the field, which its sigma does not count; check it against a fix",
    "own_track.little": "the field adds little to dead reckoning: the track has to come back to places it "
    "has met, before it has drifted by more than the field's length",
}
"""Texts of a localisation in a map that is made from the same log."""

SCALAR_TEXTS = {
    "scalar.lag": "{column} is {lag_s:.2f} s late (1-sigma {sigma_s:.2g} s): correct its clock",
    "scalar.implausible_shift": "{column}: a lag of {lag_s:.1f} s and a lever arm of {forward_m:.0f} m "
    "forward, {starboard_m:.0f} m starboard are implausible, and the map is wrong: probably they stand for "
    "the vehicle's own field; calibrate --scalar first, or give --lag and --lever",
    "scalar.shift": "{column} reads the field {shift_m:.2f} m ahead of the position (1-sigma "
    "{sigma_m:.1f} m): a lag or a lever arm",
    "scalar.heading_error": "{column} has a heading error of {effect_nT:.1f} nT (standard deviation)",
    "scalar.channel": "{channel} disturbs {column} by {effect_nT:.2f} nT (standard deviation)",
    "scalar.untested": "{column} was not tested: {reason}",
}
"""Texts of the check of a scalar magnetometer."""

DIAGNOSIS_TEXTS = {
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
    "summary.no_improvement": "The corrected field does not improve on held-out parts.",
    "summary.within_sigma": "The error that it removes hardly exceeds its own sigma: calibrate again first.",
    "summary.refit_as_good": "A refit of the calibration alone corrects as well: calibrate again instead.",
    "summary.refused": "The extension is refused. {why}. calibration.json is the calibration as it was "
    "given.",
    "summary.holds": "calibration.json is the calibration as it was given. As far as this log can show (last "
    "section), it holds.",
    "summary.nothing_added": "calibration.json is the calibration as it was given. It does not describe all "
    "that this vehicle's sensor sees: expect errors like the {before_nT:3} nT RMS found here.",
    # Why an extension is refused, with the allowed and the found value
    "refusal.reference_only": "It would have no new term: no effect found is one that it corrects",
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
"""Texts of a diagnosis."""

TEXTS = {**FIT_TEXTS, **TRACK_TEXTS, **SCALAR_TEXTS, **DIAGNOSIS_TEXTS}
CONDITION_CODES = tuple(code.removeprefix("condition.") for code in TEXTS if code.startswith("condition."))
"""Codes of the reasons against use that a condition removes, the weightiest first."""


ERRORS = {"unsupported_fit"}
"""Codes of diagnostics that stop a command unless it is forced; all others are warnings."""


class Diagnostic(NamedTuple):
    """A message: its code, and the values in its text."""

    code: str
    values: Mapping[str, Any] = {}
    about: str = ""
    """Name of the finding that the message is about, for a message outside of the finding; or empty."""

    @property
    def severity(self) -> str:
        """``error`` if it stops a command, else ``warning``."""
        return "error" if self.code in ERRORS else "warning"

    @property
    def text(self) -> str:
        """Text for people, in plain words."""
        own = write_text(self.code, **self.values)
        return write_text("of_finding", name=self.about, text=own) if self.about else own

    @property
    def numbers(self) -> dict[str, float]:
        """Values that are floating-point numbers, by name."""
        return {name: value for name, value in self.values.items() if isinstance(value, float)}


class _Numbers(Formatter):
    """Formatter with two more formats of a number: a count of significant digits, and ``%``."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text in the format `format_spec`."""
        if format_spec == "%":
            return f"{100.0 * value:.0f} %"
        return number(value, int(format_spec)) if format_spec.isdigit() else format(value, format_spec)


def write_text(code: str, **values: Any) -> str:
    """Return the text of a code with its values filled in."""
    return _Numbers().format(TEXTS[code], **values)


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant `digits` and without an exponent: 1070, not 1.07e+03."""
    rounded = float(f"{value:.{digits}g}")
    if not rounded or not isfinite(rounded):
        return f"{rounded:g}"
    places = max(digits - 1 - floor(log10(abs(rounded))), 0)
    return f"{rounded:.{places}f}".replace("-", "\N{MINUS SIGN}")
