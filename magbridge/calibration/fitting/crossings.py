"""Test if a track returns to places on other courses, to separate the crustal field from heading errors."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

from magbridge.arrays import BoolArray, FloatArray, IndexArray
from magbridge.calibration.fitting.observations import Observations
from magbridge.diagnostics import Diagnostic
from magbridge.wording import counted

MIN_CROSSING_DEG = 30.0
"""Smallest difference of two courses that cross, deg."""
REVERSED_COURSE_DEG = 150.0
"""Smallest difference of two courses of which the second is the reverse of the first, deg."""
FEW = 3
"""Smallest number of crossed places with which a survey is not warned about."""
PLACE_LENGTH_FRACTION = 0.25
"""Side of the cells that count as one place, as a fraction of the crustal field's correlation length."""
FARTHEST, NEAR = 5.0, 1000.0
"""A position is implausible beyond FARTHEST times the distance from the middle within which 99 % of samples
lie; this distance is at least NEAR, m. FARTHEST also limits steps, in multiples of the usual speed."""
PLACES = (125.0, 250.0, 500.0)
"""Sides of the cells that count as one place while the correlation length is unknown, m."""
OFTEN, TWICE = 0.08, 2
"""Smallest fraction and number of places that a survey must pass again on another course. Six hours of a
glider's criss-cross pass 11 to 17 % again at 500 m, dives along one line 5 %."""
AHEAD, LEGS = 0.8, 6
"""Mean resultant length of the courses (Mardia & Jupp 2000, eq. 2.3.3) below which legs have different
courses, and smallest number of the largest cells that the track must visit. A zigzag of 3 h without crossings
has 0 to 0.6, dives along one line 0.93."""
AREA = 120.0
"""Extent of a track below which the crustal field is nearly constant, m."""
LEAP = 100.0
"""Smallest jump in position: excess of a step over the distance that the vehicle can have moved, m."""
MIN_LENGTH_SPACINGS = 0.5
"""Smallest correlation length that neighbouring tracks resolve, as a fraction of their spacing."""
MIN_COURSE_M = 5.0
"""Smallest distance between samples that gives a course, m."""


def tells_rock(data: Observations) -> bool:
    """Return True if the track separates the crustal field from the vehicle's field.

    The track must return to places on other courses, or have enough legs with different courses.
    """
    if data.place is None:
        return False
    # two kinds of evidence: enough legs whose courses differ, or cells that were passed on other courses
    whole = np.isfinite(data.place[:, :2]).all(axis=1)
    place, course = courses(data.place[whole & ~far_off(data.place[:, :2]), :2])

    def revisits_cells(cell: float) -> bool:
        places = len(np.unique(np.floor(place / cell), axis=0))
        return sum(crossed(place, course, cell)) >= max(OFTEN * places, TWICE)

    # within a small area the crustal field is one constant
    if not len(place) or np.hypot(*np.ptp(place, axis=0)) < AREA:
        return False
    # the mean of exp(i course) is near 1 on a straight track
    legs = len(np.unique(np.floor(place / PLACES[-1]), axis=0)) >= LEGS
    return (legs and abs(np.exp(1j * course).mean()) < AHEAD) or any(map(revisits_cells, PLACES))


def left_open(track: FloatArray | None, length: float) -> Iterator[Diagnostic]:
    """Yield a warning if a `track` (n, 2+), m, passes too few places again on another course.

    `track`: track over an unmapped crustal field; None if there is no such track. `length`: correlation
    length of the crustal field, m.
    """
    if track is None:
        return
    place, course = courses(track[:, :2])
    if not len(place) or np.ptp(place, axis=0).max() < PLACE_LENGTH_FRACTION * length:
        return  # all at one place: the crustal field is a constant
    cells, reversed_cells = crossed(place, course, PLACE_LENGTH_FRACTION * length)
    if cells + reversed_cells == 0:
        yield Diagnostic("never_crossed")
    elif cells < FEW and reversed_cells < FEW:
        yield Diagnostic("few_crossings", {"places": counted(cells + reversed_cells, "place")})


def too_rough(track: FloatArray, length: float, shortest: float = 0.0) -> Iterator[Diagnostic]:
    """Yield a warning if the correlation `length` (m) of a crustal field is too short for a `track` (n, 2).

    `shortest`: shortest length that the fit tried, m; a fit that ends there has not found the length.
    """
    place = courses(track)[0]
    if len(place) < FEW:
        return
    # spacing of the lines: the area of the hull over the length of the track
    way = float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum())
    apart = float(ConvexHull(place, qhull_options="QJ").volume) / way  # in a plane its volume is an area
    if length < MIN_LENGTH_SPACINGS * apart:
        yield Diagnostic("rough_crust", {"length_m": length, "spacing_m": apart})
    elif length <= shortest:
        yield Diagnostic("shortest_crust", {"length_m": length, "shortest_m": shortest})


def far_off(place: FloatArray) -> BoolArray:
    """Return a mask (n,) that is True for positions (n, 2), m, implausibly far from the others, or NaN."""
    # robust: the median is the middle, and the 99 % quantile the usual distance
    distance = np.linalg.norm(place - np.nanmedian(place, axis=0), axis=1)
    usual = max(float(np.nanquantile(distance, 0.99)), NEAR)
    return np.asarray(~(distance <= FARTHEST * usual))


def jumped(place: FloatArray, time: FloatArray) -> Iterator[Diagnostic]:
    """Yield messages about unknown and implausible positions, and about jumps of the track.

    `place` (n, 2): positions, m. `time` (n,): s.
    """
    without = ~np.isfinite(place).all(axis=1)
    far = far_off(place) & ~without
    for left_out, code in ((without, "without_position"), (far, "far_position")):
        if count := int(left_out.sum()):
            yield Diagnostic(code, {"samples": counted(count, "sample")})
    kept = ~without & ~far
    if kept.sum() < FEW:
        return
    at = jumps(place[kept], time[kept])
    if len(at):
        step = np.linalg.norm(np.diff(place[kept], axis=0)[at], axis=1)
        values = {"step_m": float(step.max()), "jumps": counted(len(at), "jump"), "limit_m": LEAP}
        yield Diagnostic("position_jumps", values)


def jumps(place: FloatArray, time: FloatArray) -> IndexArray:
    """Return the indices of the positions after which the track jumps.

    `place` (n, 2): positions, m. `time` (n,): s.
    """
    # a jump is a step that the usual speed does not explain
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    usual = float(np.median(step / np.maximum(np.diff(time), 1e-3)))
    beyond = step - FARTHEST * usual * np.diff(time)
    return np.flatnonzero((beyond > LEAP) & (usual > 0.0))


def crossed(place: FloatArray, course: FloatArray, cell: float) -> tuple[int, int]:
    """Return the number of cells in which courses cross, and of other cells in which they are reversed.

    `place` (n, 2): positions, m. `course` (n,): rad. `cell`: side of a cell, m.
    """
    # number the cells, and go through the samples cell by cell
    _, of = np.unique(np.floor(place / cell).astype(np.int64), axis=0, return_inverse=True)
    of = of.ravel()
    order = np.argsort(of, kind="stable")
    edges = np.flatnonzero(np.diff(of[order], prepend=-1, append=-1))
    across = back = 0
    for first, last in pairwise(edges):
        here = np.sort(order[first:last])
        new = np.flatnonzero(np.diff(here, prepend=-9) > 1)  # another visit
        # mean course of each visit, then the angles between all pairs of visits
        passes = np.angle(np.add.reduceat(np.exp(1j * course[here]), new))
        apart = np.degrees(np.abs(np.angle(np.exp(1j * (passes[:, None] - passes)))))
        if ((apart > MIN_CROSSING_DEG) & (apart < REVERSED_COURSE_DEG)).any():
            across += 1
        elif (apart >= REVERSED_COURSE_DEG).any():
            back += 1
    return across, back


def courses(place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (m, 2) at steps of at least :data:`MIN_COURSE_M`, and the courses from them (m,), rad.

    `place` (n, 2): positions, m.
    """
    way = np.cumsum(np.hypot(*np.diff(place, axis=0, prepend=place[:1]).T))
    moved = np.diff(np.floor(way / MIN_COURSE_M), prepend=-1) > 0
    step = np.diff(place[moved], axis=0)
    return place[moved][:-1], np.arctan2(step[:, 1], step[:, 0])
