"""Figure of merit and improvement ratio of a compensated magnetometer on a box flight.

Notes
-----
A box has four headings, and on each of them rolls, pitches and yaws with periods of 4 to 5 s. The figure of
merit is the sum of the twelve peak-to-peak values that these manoeuvres leave in the field. The improvement
ratio is the standard deviation before compensation over that after it. Both refer to the field between 0.1
and 0.6 Hz (Noriega 2011, The Leading Edge 30:1122).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfiltfilt

from magbridge.arrays import BoolArray, FloatArray

MANOEUVRE_AXES = ("roll", "pitch", "yaw")
BAND_HZ = (0.1, 0.6)
"""Band of the manoeuvres, Hz."""
USUAL_AMPLITUDE_DEG = (10.0, 5.0, 5.0)
"""Amplitude of the rolls, pitches and yaws of a box, deg."""
MIN_AMPLITUDE_FRACTION = 0.35
"""Fraction of the usual amplitude from which on an oscillation is a manoeuvre."""
MAX_OTHER_AXES = 0.4
"""Amplitude of the other axes in units of that of the manoeuvre's axis, each relative to the usual one: gusts
move all axes. Of 80 simulated logs with gusts of 1.5 to 4 deg RMS one counts as a box (at 0.3 none, at 0.5
three), and of boxes with gusts of 1 deg and rolls that yaw, all do (at 0.3, three in four)."""
WINDOW_S, MIN_DURATION_S = 6.0, 8.0
"""Window of an oscillation's amplitude, and duration of the shortest manoeuvre, s."""
MIN_RATE_HZ = 1.5
"""Lowest rate, Hz, of a log in which manoeuvres can be seen."""
MIN_MANOEUVRES = 8
"""Manoeuvres of the twelve that make a flight a box."""
QUARTER_TURN_DEG = 90.0


class Manoeuvre(NamedTuple):
    """An oscillation about one axis on one heading."""

    axis: str
    """``roll``, ``pitch`` or ``yaw``."""
    heading: float
    """Mean heading, deg."""
    rows: slice
    """Samples of the log."""


class BoxFlight(NamedTuple):
    """The manoeuvres of a box: at most one for each axis and heading."""

    manoeuvres: tuple[Manoeuvre, ...]
    interval: float
    """Time between samples, s."""

    def rows(self, n: int) -> BoolArray:
        """Return True for samples (n,) that belong to a manoeuvre."""
        inside = np.zeros(n, bool)
        for one in self.manoeuvres:
            inside[one.rows] = True
        return inside


def box_flight(
    time: FloatArray, roll: FloatArray, pitch: FloatArray, heading: FloatArray
) -> BoxFlight | None:
    """Return the manoeuvres of a box flight, or None if too few were flown or the log is too slow.

    `time` (n,): s, ascending. `roll`, `pitch`, `heading` (n,): deg; NaN where unknown.
    """
    if len(time) < 100:
        return None
    interval = float(np.median(np.diff(time)))
    if interval <= 0.0 or 1.0 / interval < MIN_RATE_HZ:
        return None
    # Amplitude of roll, pitch and yaw in the band of the manoeuvres: RMS over a window, times sqrt(2).
    turned = np.degrees(np.unwrap(np.radians(_filled(heading))))
    angles = np.stack([_filled(roll), _filled(pitch), turned], axis=1)
    if not np.isfinite(angles).all():
        return None
    window = max(3, round(WINDOW_S / interval))
    power = uniform_filter1d(_band(angles, interval) ** 2, window, axis=0)
    swing = np.sqrt(2.0 * np.maximum(power, 0.0))  # rounding leaves running sums below zero
    relative = swing / np.array(USUAL_AMPLITUDE_DEG)
    # The axis with the largest swing relative to the usual amplitude, -1 without a swing, and the largest
    # swing of the other axes in units of its own.
    _, second, largest = np.sort(relative, axis=1).T
    others = second / np.maximum(largest, 1e-300)
    axis = np.where(relative.max(axis=1) > MIN_AMPLITUDE_FRACTION, relative.argmax(axis=1), -1)
    axis[np.append(np.diff(time) > 3.0 * interval, False)] = -1
    # Stretches with the same axis are candidates for a manoeuvre.
    edges = [0, *(np.flatnonzero(np.diff(axis)) + 1).tolist(), len(axis)]
    found = [
        Manoeuvre(MANOEUVRE_AXES[axis[begin]], float(turned[begin:end].mean() % 360.0), slice(begin, end))
        for begin, end in pairwise(edges)
        if axis[begin] >= 0
        and time[end - 1] - time[begin] >= MIN_DURATION_S
        and np.median(others[begin:end]) < MAX_OTHER_AXES
    ]
    best = _one_for_each_heading(found)
    return BoxFlight(best, interval) if len(best) >= MIN_MANOEUVRES else None


def _one_for_each_heading(found: list[Manoeuvre]) -> tuple[Manoeuvre, ...]:
    """Return the longest manoeuvre of each axis and of each of four headings.

    The orientation of the box is the mean of the headings modulo a quarter turn.
    """
    if not found:
        return ()
    # Circular mean of four times the heading: headings a quarter turn from each other coincide.
    fourfold = np.exp(4j * np.radians([one.heading for one in found])).mean()
    first = float(np.degrees(np.angle(fourfold))) / 4.0
    longest: dict[tuple[int, str], Manoeuvre] = {}
    for one in sorted(found, key=lambda one: one.rows.start - one.rows.stop):  # the longest first
        longest.setdefault((round((one.heading - first) / QUARTER_TURN_DEG) % 4, one.axis), one)
    return tuple(
        longest[key] for key in sorted(longest, key=lambda key: (key[0], MANOEUVRE_AXES.index(key[1])))
    )


def figure_of_merit(box: BoxFlight, measured: FloatArray, compensated: FloatArray) -> dict[str, Any]:
    """Return figure of merit and improvement ratio as plain values, with those of each manoeuvre.

    `measured`, `compensated` (n,): field before and after compensation, nT; NaN where unknown. A sample that
    is unknown in one of them is not used in the other.
    """
    unknown = np.isnan(measured) | np.isnan(compensated)
    # Peak to peak of each manoeuvre in the band; their sum is the figure of merit.
    both = (np.where(unknown, np.nan, values) for values in (measured, compensated))
    seen = [_band(_filled(values), box.interval) for values in both]
    table: list[dict[str, Any]] = [
        {
            "axis": one.axis,
            "heading_deg": round(one.heading, 1),
            "before_nT": float(np.ptp(seen[0][one.rows])),
            "after_nT": float(np.ptp(seen[1][one.rows])),
        }
        for one in box.manoeuvres
    ]
    inside = box.rows(len(measured))
    spread = [float(np.std(values[inside])) for values in seen]
    return {
        "before_nT": float(sum(row["before_nT"] for row in table)),
        "after_nT": float(sum(row["after_nT"] for row in table)),
        "improvement_ratio": spread[0] / max(spread[1], 1e-9),
        "manoeuvres": len(table),
        "peak_to_peak": table,
    }


def merit_text(merit: dict[str, Any]) -> str:
    """Return a figure of merit as a sentence."""
    return (
        f"figure of merit {merit['before_nT']:.2f} -> {merit['after_nT']:.2f} nT over "
        f"{merit['manoeuvres']} manoeuvres, improvement ratio {merit['improvement_ratio']:.1f}"
    )


def _filled(values: FloatArray) -> FloatArray:
    """Return values (n,) with gaps interpolated; all NaN where nothing is known."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.asarray(values, float)
    rows = np.arange(len(values))
    return np.interp(rows, rows[known], values[known])


def _band(values: FloatArray, interval: float) -> FloatArray:
    """Return the part of values (n, ...) between the two frequencies of the manoeuvres."""
    highest = min(BAND_HZ[1], 0.45 / interval)
    sections = butter(2, (BAND_HZ[0], highest), "bandpass", fs=1.0 / interval, output="sos")
    return np.asarray(sosfiltfilt(sections, values, axis=0))
