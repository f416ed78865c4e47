"""Is the extended calibration fit for use? The assessment's answer, on the page's first screen."""

from __future__ import annotations

from html import escape

from magbridge.diagnose.assessment.notes import Note
from magbridge.diagnose.assessment.numbers import Delays
from magbridge.diagnose.assessment.weigh import Assessment, Fitness
from magbridge.diagnose.gain import Gain
from magbridge.diagnose.report.words import measured, number

__all__ = ["decision", "gained", "late", "paragraph"]

MARKS: dict[Fitness, str] = {
    "yes": "good", "once_settled": "doubt", "no": "bad", "nothing_added": "none", "reference_only": "none",
}  # fmt: skip
"""How an answer is marked."""


def decision(found: Assessment) -> str:
    """Return the answer with its reasons as a box."""
    mark = MARKS[found.fit_for_use]
    if found.fit_for_use == "reference_only" and found.reasons_against:
        mark = "doubt"
    reasons = [*found.reasons_for, *found.reasons_against]
    listed = "".join(f"<li>{escape(reason.text)}</li>" for reason in reasons)
    return (
        f'<div class="box {mark}"><p><b>Is the extended calibration fit for use?</b> {escape(found.answer)}'
        f"</p>{f'<ul>{listed}</ul>' if listed else ''}</div>"
    )


def paragraph(note: Note) -> str:
    """Return a note as HTML."""
    return f"<p>{escape(note.text)}</p>"


def gained(gain: Gain, parts: str) -> str:
    """Tell what all findings together improve on what was left out, and say so when that shows nothing."""
    low, high = gain.interval
    return (
        f"On {parts} left out of the fit, {number(gain.before)} nT RMS became {number(gain.after)} nT "
        f"(ratio {gain.ratio:.2f}, 95 % interval {low:.2f} to "
        f"{high:.2f}{'' if gain.shown else ': no gain is shown'})."
    )


def late(found: Delays | None) -> str:
    """Say so when the channels look interpolated, which adds a noise that no calibration can undo."""
    if found is None:
        return ""
    y, z = (f"{measured(x, s)} ± {measured(s, s)} s" for x, s in zip(found.later, found.sigma, strict=True))
    return (
        "<p>The channels look as if they were sampled in turn and interpolated to the time of each row: y "
        f"{y} and z {z} later than x (a channel that is noisier than the others would look the same). The "
        f"{number(found.rms)} nT RMS that this causes is removed from what follows. To avoid it, sample all "
        "three channels at once, or faster than the vehicle sways, or log each channel's own time "
        "(mag_time_x, mag_time_y, mag_time_z).</p>"
    )
