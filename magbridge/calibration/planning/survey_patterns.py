"""Compare patterns of a self-calibrating survey by the error that each is expected to leave.

The vehicle trims, rolls and moves its masses as in the mission. A pattern sets the course of each leg, and
may alternate the roll from leg to leg. The Jacobian of the samples, with the crustal field as a Gaussian
field (:mod:`~magbridge.estimation.elimination`), gives the coefficients' covariance before the survey is
flown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.crossings import courses, crossed, left_open
from magbridge.calibration.fitting.field_search import nodes_for
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import Mission
from magbridge.calibration.model import Calibration
from magbridge.calibration.planning.plan import Design, expected_calibration, mission_samples
from magbridge.columns import require_units
from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import CalibrationError
from magbridge.estimation.elimination import LinearisedRows, eliminate_field, sum_rows
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.information import covariance_of
from magbridge.estimation.priors import polynomial_prior
from magbridge.estimation.residual import jacobian

if TYPE_CHECKING:
    import xarray as xr


ROCK, LENGTH, SMOOTH = 40.0, 700.0, 3
"""Amplitude (nT), correlation length (m) and power of the crustal field assumed at an unmapped place."""
PATTERN_SAMPLES = 1_500
"""Approximate number of samples that represent a pattern; each stands for the average of its neighbours."""
SPIRAL = 1_800.0
"""Duration of the spiral at the end of a survey, s."""


@dataclass(frozen=True)
class Proposal:
    """Survey pattern with its expected accuracy."""

    name: str
    rms: float
    worst: float
    """`rms`, `worst`: RMS and largest 1-sigma of the corrected field about its mean over the mission, nT."""
    crossings: int
    """Number of places that the track passes again on another course."""
    open: tuple[str, ...]
    """Advice on what the track cannot separate from the crustal field, one text each."""


def survey_plan(
    calibration: Calibration | None,
    mission: xr.Dataset,
    parameters: tuple[str, ...] = (),
    *,
    hours: float,
    roll: float = 10.0,
) -> list[Proposal]:
    """Return patterns of a self-calibrating survey of `hours`, the best first.

    `mission`, `roll` and errors as for :func:`.plan.flight_plan`. `calibration`: None for an unknown vehicle;
    `parameters` then names the columns of its masses' positions.
    """
    if calibration is not None:
        require_units(mission, calibration.units)
        parameters = tuple(calibration.units)
    data = mission_samples(mission.drop_vars("reference_field", errors="ignore"), parameters)
    # an unknown vehicle has the expected calibration, with the uncertainty of its prior
    if calibration is None:
        calibration = expected_calibration(data.ranges(), float(np.median(data.reference)))
    return propose(calibration, data, hours=hours, roll=roll)


def propose(
    calibration: Calibration, data: Observations, *, hours: float, roll: float = 10.0
) -> list[Proposal]:
    """Return patterns of a self-calibrating survey of `hours`, the pattern with the smallest error first.

    `calibration`: point of linearisation, and noise of a sample. `data`: attitude, position and masses as in
    the mission. `roll`: largest roll to either side, deg.

    CalibrationError: the mission has no attitude or position, or does not move.
    """
    known, attitude, ned = data.directed()
    if not known.any() or data.place is None:
        raise CalibrationError("the mission needs roll, pitch, heading, latitude and longitude")
    time, place = data.time[known], data.place[known, :2]
    # The patterns have the speed, sampling and attitudes of the mission.
    speed = float(np.median(np.hypot(*np.diff(place, axis=0).T) / np.maximum(np.diff(time), 1e-3)))
    if not speed > 0.0:
        raise CalibrationError("the mission does not move: no survey can be flown like it")
    mission = Mission.from_observations(data)
    field = np.asarray(ned.mean(axis=0))
    count = int(hours * 3600.0 / float(np.median(np.diff(time))))
    rows = np.arange(0, count, max(count // PATTERN_SAMPLES, 1))
    interval, as_flown = hours * 3600.0 / len(rows), rows % len(attitude)
    noise = calibration.noise.sensor * max(len(rows) / count, 1e-9) ** 0.5
    found = []
    with threadpool_limits(1, "blas"):
        design = Design(calibration, mission, field)
        for name, course, bank in _patterns(len(rows), interval, speed, roll):
            flown = np.column_stack([attitude[as_flown, 0] + bank, attitude[as_flown, 1], course])
            # Integrate speed and course to positions.
            step = speed * interval * np.stack([np.cos(course), np.sin(course)], axis=1)
            where = np.cumsum(step, axis=0)
            positions = data.parameters[known][as_flown]
            rms, worst = _expected(design, flown, where, positions, noise)
            met = sum(crossed(*courses(where), 0.25 * LENGTH))
            found.append(Proposal(name, rms, worst, met, tuple(one.text for one in left_open(where, LENGTH))))
    return sorted(found, key=lambda one: one.worst)


def _patterns(
    n: int, interval: float, speed: float, roll: float
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Yield name, course (n,) and bank (n,), rad, of every pattern of n samples, every `interval` (s)."""
    # Fraction of the survey at each sample; `level` flight has no bank.
    share, level = (np.arange(n) + 0.5) / n, np.zeros(n)
    bank = np.radians(roll) * np.where(np.arange(n) * 24 // n % 2, 1.0, -1.0)
    yield "straight ahead", np.zeros(n), level
    yield "there and back", np.where(share < 0.5, 0.0, np.pi), level
    lines = _lines(share, 8, speed * interval * n)
    yield "parallel lines", lines, level
    crossing = np.where(share < 0.5, _lines(2.0 * share, 5, speed * interval * n / 2.0), 0.0)
    later = share >= 0.5
    crossing[later] = 0.5 * np.pi - _lines(2.0 * share[later] - 1.0, 5, speed * interval * n / 2.0)
    yield "lines and ties", crossing, level
    leg = np.minimum((share * 24).astype(int), 23)
    star = np.radians(125.0) * leg
    yield "criss-cross on all courses", star, level
    yield f"criss-cross, legs banked {roll:.0f} deg either way in turn", star, bank
    turning = np.arange(n) * interval > (n * interval - SPIRAL)
    circles = np.where(turning, 8.0 * np.pi * np.linspace(0.0, 1.0, n) * n * interval / SPIRAL, star)
    yield "criss-cross, half an hour of spiral at the end", circles, np.where(turning, np.radians(roll), 0.0)


def _lines(share: FloatArray, count: int, length: float) -> FloatArray:
    """Return courses (n,), rad, along parallel lines, at fractions `share` (n,) of a track of `length` m."""
    # fraction of a line's part of the track that leads to the next line
    aside = min(0.1, 0.5 * LENGTH * count / max(length, 1.0))
    part = share * count
    line, within = part.astype(int), part % 1.0
    return np.where(within > 1.0 - aside, 0.5 * np.pi, np.where(line % 2, np.pi, 0.0))


def _expected(
    design: Design, attitude: FloatArray, place: FloatArray, positions: FloatArray, noise: float
) -> tuple[float, float]:
    """Return RMS and largest 1-sigma of the corrected field about its mean over the mission, nT."""
    calibration = design.calibration
    truth = field_body(attitude, np.tile(design.field_ned, (len(attitude), 1)))
    phi, g = design.derivative(truth, positions)
    names = tuple(one.name for one in calibration.parameters)
    family = polynomial_prior(design.exponents, names, calibration.reference.field)
    # Unknowns of the self-calibrating survey: coefficients, crustal field on nodes, and a constant bias.
    D = np.column_stack([np.zeros(len(phi)), jacobian(phi, g) @ family.E, -np.ones(len(phi))])
    field = GaussianField(nodes_for(place, LENGTH, SMOOTH), LENGTH, SMOOTH)
    sums = sum_rows([LinearisedRows(D, -field.basis(place), np.zeros(len(phi), bool))])
    # Eliminate the field; prior and data give the covariance of the coefficients.
    H = eliminate_field(sums, field, ROCK / noise, 0.0).quadratic.precision / noise**2
    prior = np.append(family.widths(family.centre), MAIN_FIELD_SIGMA_NT) ** -2.0
    P = covariance_of(H + np.diag(prior))[:-1, :-1]
    # Error over the mission about its mean: the constant bias cancels.
    points = (design.points - design.points.mean(axis=0)) @ family.E
    variance = np.einsum("ij,jk,ik->i", points, P, points)
    return float(np.sqrt(variance.mean())), float(np.sqrt(variance.max()))


def facts(found: list[Proposal]) -> dict[str, Any]:
    """Return the proposals as values for JSON."""
    keys = "pattern", "expected_rms_nT", "expected_worst_nT", "places_met_again", "open"
    return {"surveys": [dict(zip(keys, astuple(one), strict=True)) for one in found]}


def summary(found: list[Proposal]) -> str:
    """Return the proposals as a text table."""
    header = (
        f"{'survey':52} {'met again':>9} {'error about the mean over the mission, nT: RMS':>48} {'worst':>7}"
    )
    lines = [f"{one.name:52} {one.crossings:9} {one.rms:48.2f} {one.worst:7.2f}" for one in found]
    note = (
        f"over a crustal field of {ROCK:.0f} nT and {LENGTH:.0f} m, an unknown vehicle, no calibration run, "
        "no map; the level stays as uncertain as the main field's"
    )
    return "\n".join([header, *lines, note])
