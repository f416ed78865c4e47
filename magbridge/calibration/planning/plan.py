"""Choose the calibration runs to fly next, so that the largest error over the mission becomes smallest.

Notes
-----
A run at one pitch, roll and position, on all headings, adds the information ``phi phi^T (x) G``. Here phi are
the monomials of the position, g the derivative of the residual by the nine slots, and ``G`` the sum of
``g g^T / sigma^2`` over the run's samples. With the calibration's covariance C and ``F = phi (x) G^(1/2)``,
the covariance after the run is::

    C' = C - C F (I + F^T C F)^-1 F^T C

:func:`plan` chooses runs one by one, then exchanges them (Fedorov), to minimise the largest error over the
mission (G-optimality). The eighth power mean of the errors, which is smooth, approximates the largest error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import forward
from magbridge.calibration.fitting.boresight import field_body
from magbridge.calibration.fitting.observations import Observations, monomials
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.uncertainty import Mission
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.columns import require_units
from magbridge.datasets import expect, standard_log
from magbridge.errors import CalibrationError
from magbridge.estimation.noise import effective_fraction
from magbridge.estimation.priors import polynomial_prior
from magbridge.estimation.residual import ResidualSamples, jacobian, residuals

if TYPE_CHECKING:
    import xarray as xr


SLACK = 3.0
"""Difference of pitch from the trim that the vehicle can fly at the same positions, deg."""
MAX_REST_FRACTION = 0.01
"""Largest motion of a mass at rest between samples, as a fraction of half a position's range."""
MAX_POSITION_DIFFERENCE = 0.35
"""Largest distance of a run from flown positions, as a fraction of half a position's range."""
PLANNED_HEADINGS = 24
"""Number of headings that represent a run on all headings."""
PLANNED_RUN_SAMPLES = 225
"""Number of samples of a run: a quarter of an hour at the paper's 0.25 Hz."""
POSITION_LEVELS = 7
"""Number of values of each position that the search tries."""
VARIANCE_POWER = 4
"""Power of the variance that is averaged over the mission: the eighth power of sigma."""


@dataclass(frozen=True)
class PlannedRun:
    """Planned calibration run: a spiral on all headings with fixed pitch, roll and positions."""

    pitch: float
    roll: float
    """`pitch`, `roll`: Attitude, deg."""
    parameters: tuple[float, ...]
    """Value of each parameter, in its unit."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the attitudes and positions that the vehicle can fly."""

    roll: tuple[float, float] = (-10.0, 10.0)
    """Smallest and largest roll in a spiral, deg."""
    pitch: tuple[float, float] = (14.0, 30.0)
    """Smallest and largest absolute pitch of dives and climbs, deg."""
    pitch_at: Callable[[FloatArray], float] | None = None
    """Function of the positions (k,) that returns the pitch (deg) of the trimmed vehicle; None: any pitch."""
    flown: FloatArray | None = None
    """(m, k): Positions that the vehicle has flown, near which a run must stay; None: any position."""


def trim_of(data: Observations) -> Callable[[FloatArray], float] | None:
    """Return a linear function of the positions (k,) that gives the trimmed vehicle's pitch, deg.

    The result is None if the positions explain less than 90 % of the variance of pitch in `data`.
    """
    if data.attitude is None or not data.names:
        return None
    # Linear regression of pitch on positions; unusable if it explains less than 90 % of the variance.
    known = np.isfinite(data.attitude[:, 1])
    pitch = np.degrees(data.attitude[known, 1])
    design = np.column_stack([np.ones(len(pitch)), data.parameters[known]])
    if len(pitch) <= design.shape[1]:
        return None
    trim, *_ = np.linalg.lstsq(design, pitch, rcond=None)
    if np.var(pitch - design @ trim) > 0.1 * np.var(pitch):
        return None
    return lambda positions: float(trim[0] + positions @ trim[1:])


def settled(data: Observations, parameters: tuple[Parameter, ...]) -> FloatArray:
    """Return the positions (m, k) of the samples of `data` in which all masses are at rest."""
    scale = [parameter.scale for parameter in parameters]
    # A sample is at rest if no mass moved before or after it.
    moving = (np.abs(np.diff(data.parameters, axis=0) / scale) > MAX_REST_FRACTION).any(axis=1)
    at_rest = ~(np.append(False, moving) | np.append(moving, False))
    return np.asarray(data.parameters[at_rest])


def candidate_runs(limits: Limits, parameters: tuple[Parameter, ...], levels: int) -> list[PlannedRun]:
    """Return all runs within the limits, on a grid with `levels` values of each position."""
    # Grid over positions, pitch and roll; only positions near flown ones, and pitches near their trim.
    rolls = np.unique(np.append(np.linspace(*limits.roll, 5), np.clip(0.0, *limits.roll)))
    found = []
    for positions in product(*(np.linspace(one.low, one.high, levels) for one in parameters)):
        if limits.flown is not None:
            off = np.abs(positions - limits.flown) / [parameter.scale for parameter in parameters]
            if not (off.max(axis=1) <= MAX_POSITION_DIFFERENCE).any():
                continue
        if limits.pitch_at is None:
            steep = np.linspace(*limits.pitch, 3)
            pitches = [*(-steep), *steep]
        else:
            trim = limits.pitch_at(np.array(positions))
            pitches = [trim - SLACK, trim, trim + SLACK]
        found += [
            PlannedRun(float(pitch), float(roll), tuple(float(p) for p in positions))
            for pitch in pitches
            for roll in rolls
            if limits.pitch[0] <= abs(pitch) <= limits.pitch[1]
        ]
    return found


@dataclass(frozen=True)
class Plan:
    """Sequence of runs to fly, and the error that is expected after each run."""

    runs: tuple[PlannedRun, ...]
    """Runs in the order of flight."""
    rms: tuple[float, ...]
    worst: tuple[float, ...]
    """`rms`, `worst`: RMS and largest expected error over the mission, nT, before any and after each run."""


def expected_calibration(
    parameters: tuple[Parameter, ...], field: float, order: int = 3, noise: float = 1.0
) -> Calibration:
    """Return a calibration that represents the prior of a vehicle before its first run.

    Its coefficients are 0, with the covariance of the physical prior. `field`: field where the runs are
    flown, nT. `order`: highest total degree of the polynomials. `noise`: 1-sigma of a sample, nT.
    """
    exponents = full_order(len(parameters), order)
    family = polynomial_prior(exponents, tuple(p.name for p in parameters), field)
    # Prior covariance E diag(w^2) E^T at the centre of the hyperparameters.
    E = family.E * family.widths(family.centre)
    return Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=np.zeros(len(E)),
        covariance=E @ E.T,
        noise=Noise(noise),
        reference=Reference(field),
        method="none",
    )


class Design:
    """Covariance updates by candidate runs, with the residual linearised about one calibration.

    `mission`: fields and positions at which the error matters. `field_ned` (3,): field where the runs are
    flown, nT. CalibrationError: the calibration does not consist of one polynomial, or has no noise.
    """

    def __init__(self, calibration: Calibration, mission: Mission, field_ned: FloatArray) -> None:
        if len(calibration.terms) != 1 or calibration.effects:
            raise CalibrationError(
                "plan: needs a calibration of polynomials only, as magbridge calibrate makes it, not one "
                "that diagnose extended"
            )
        if not calibration.noise.sensor > 0.0:
            raise CalibrationError("plan: needs the noise of a sample, which the calibration says is 0 nT")
        self.calibration, self.field_ned = calibration, field_ned
        self.exponents = calibration.terms[0].exponents
        phi, g = self.derivative(mission.field_body, mission.parameters)
        self.points = jacobian(phi, g)

    def derivative(self, truth: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return monomials (n, m), and derivatives (n, 9) of the residual by the nine slots of A and T.

        `truth` (n, 3): true field in body axes, nT. `positions` (n, k): in the parameters' units.
        """
        calibration = self.calibration
        # Derivative of the residual at noise-free readings of the true field.
        phi = monomials(positions, calibration.parameters, self.exponents)
        reading = forward(calibration, truth, positions, np.zeros(len(truth)))
        size, alone = np.linalg.norm(truth, axis=1), np.full(len(truth), np.inf)
        samples = ResidualSamples(reading, size, phi, alone, calibration.reference.field)
        return phi, residuals(samples, calibration.coefficients)[1]

    def factor(self, run: PlannedRun) -> FloatArray:
        """Return the factor F (K, 9) of the information that a run on all headings adds."""
        # One spiral at fixed pitch and roll: its information is phi phi^T (x) G (see the module's notes).
        turn = np.linspace(0.0, 2.0 * np.pi, PLANNED_HEADINGS, endpoint=False)
        attitude = np.column_stack([np.radians([[run.roll, run.pitch]] * PLANNED_HEADINGS), turn])
        truth = field_body(attitude, np.tile(self.field_ned, (PLANNED_HEADINGS, 1)))
        phi, g = self.derivative(truth, np.tile(run.parameters, (PLANNED_HEADINGS, 1)))
        noise = self.calibration.noise
        # Correlated noise reduces the number of independent samples.
        share = effective_fraction(noise.autocorrelation, noise.white)
        weight = PLANNED_RUN_SAMPLES / PLANNED_HEADINGS / noise.sensor**2 * share
        # F = phi (x) G^(1/2): a root of the information, so that the update has rank nine.
        values, vectors = np.linalg.eigh(g.T @ g * weight)
        return np.asarray(np.kron(phi[:1].T, vectors * np.sqrt(np.maximum(values, 0.0))), np.float64)

    def variances(self, C: FloatArray) -> FloatArray:
        """Return the variance of the residual at each point of the mission, (n,), nT².

        `C` (K, K): covariance of the coefficients.
        """
        return np.asarray(np.einsum("ij,jk,ik->i", self.points, C, self.points))

    def covariance_after(self, C: FloatArray, F: FloatArray) -> FloatArray:
        """Return the covariance (K, K) after a run with the factor F (K, 9), from that before the run."""
        # Woodbury: C' = C - C F (I + F^T C F)^-1 F^T C.
        CF = C @ F
        return np.asarray(C - CF @ np.linalg.solve(np.eye(F.shape[1]) + F.T @ CF, CF.T))

    def scores(self, C: FloatArray, factors: Sequence[FloatArray]) -> FloatArray:
        """Return the criterion (m,) after each candidate run: the mean of the variance's fourth power."""
        PC, before = self.points @ C, self.variances(C)
        found = []
        for F in factors:
            # Variance at each point after the run: diag(P C P^T) minus diag(U (I + F^T C F)^-1 U^T).
            U = PC @ F
            reduction = np.einsum("ij,ji->i", U, np.linalg.solve(np.eye(F.shape[1]) + F.T @ C @ F, U.T))
            found.append(np.mean(np.maximum(before - reduction, 0.0) ** VARIANCE_POWER))
        return np.array(found)


def evaluate_runs(
    calibration: Calibration, mission: Mission, field_ned: FloatArray, runs: Sequence[PlannedRun]
) -> Plan:
    """Return a plan of the given runs in their order, with the error expected after each run.

    `field_ned` (3,): field where the runs are flown, nT.
    """
    design = Design(calibration, mission, field_ned)
    C = calibration.covariance
    course = [design.variances(C)]
    for run in runs:
        C = design.covariance_after(C, design.factor(run))
        course.append(np.maximum(design.variances(C), 0.0))
    return Plan(
        tuple(runs),
        tuple(float(np.sqrt(v.mean())) for v in course),
        tuple(float(np.sqrt(v.max())) for v in course),
    )


def plan(
    calibration: Calibration, mission: Mission, field_ned: FloatArray, limits: Limits, *, runs: int = 10
) -> Plan:
    """Return a plan of the runs after which the largest error over the mission is smallest.

    `mission`: fields and positions at which the error should be small. `field_ned` (3,): field where the runs
    are flown, nT. `runs`: number of runs.

    CalibrationError: no run lies within the limits.
    """
    with threadpool_limits(1, "blas"):  # for matrices this small threads cost more than they gain
        design = Design(calibration, mission, field_ned)
        candidates = candidate_runs(limits, calibration.parameters, POSITION_LEVELS)
        if not candidates:
            raise CalibrationError("plan: no pitch, roll and position lie within the vehicle's limits")
        factors = [design.factor(run) for run in candidates]
        # Greedy choice: each run is the one that reduces the criterion most.
        chosen: list[int] = []
        C = calibration.covariance
        for _ in range(runs):
            chosen.append(int(np.argmin(design.scores(C, factors))))
            C = design.covariance_after(C, factors[chosen[-1]])
        for _ in range(3):  # exchanges: replace each run by the best candidate, given the other runs
            changed = False
            for i in range(len(chosen)):
                C = calibration.covariance
                for j in chosen[:i] + chosen[i + 1 :]:
                    C = design.covariance_after(C, factors[j])
                scores = design.scores(C, factors)
                best = int(np.argmin(scores))
                if scores[best] < (1.0 - 1e-6) * scores[chosen[i]]:
                    chosen[i], changed = best, True
            if not changed:
                break
        return evaluate_runs(calibration, mission, field_ned, [candidates[i] for i in chosen])


# ---- From a log that flies as the mission will ----


def flight_plan(calibration: Calibration, mission: xr.Dataset, *, runs: int = 10, roll: float = 10.0) -> Plan:
    """Return a plan of the calibration runs to fly before a mission.

    `mission`: attitude, position and masses as in the mission; it needs no magnetometer. `runs`: number of
    runs. `roll`: largest roll to either side, deg.

    CalibrationError: the mission has no attitude or position. FormatError: it lacks a parameter of the
    calibration, or has it in another unit.
    """
    expect("calibration", calibration, Calibration, "magbridge.load(path)")
    mission = standard_log(mission)
    require_units(mission, calibration.units)
    names = tuple(calibration.units)
    data = mission_samples(mission, names)
    if data.reference_ned is None:
        raise CalibrationError("the mission needs latitude and longitude, to know the Earth's field there")
    # plan runs at trims that occur in the mission, because the vehicle can fly them
    flown = settled(data, calibration.parameters) if names else None
    limits = Limits(roll=(-roll, roll), pitch_at=trim_of(data), flown=flown)
    return plan(
        calibration,
        Mission.from_observations(data),
        np.nanmean(data.reference_ned, axis=0),
        limits,
        runs=runs,
    )


def mission_samples(mission: xr.Dataset, names: tuple[str, ...]) -> Observations:
    """Return the samples of a mission, with placeholders for the magnetometer's readings.

    `names`: columns of the positions.
    """
    some = ("time", np.ones(mission.sizes["time"]))  # zeros would count as missing
    return observations(mission.assign({f"mag_{axis}": some for axis in "xyz"}), names)


def facts(found: Plan, calibration: Calibration) -> dict[str, Any]:
    """Return a plan as values for JSON: the runs, and the expected error before and after each, nT."""
    names = [parameter.name for parameter in calibration.parameters]
    return {
        "expected_rms_nT": found.rms,
        "expected_worst_nT": found.worst,
        "runs": [
            {"pitch": run.pitch, "roll": run.roll, **dict(zip(names, run.parameters, strict=True))}
            for run in found.runs
        ],
    }


def summary(found: Plan, calibration: Calibration) -> str:
    """Return a plan as a text table of the runs and the error expected after each run."""
    names = [f"{one.name} [{one.unit}]" if one.unit else one.name for one in calibration.parameters]
    header = f"{'run':>4} {'pitch':>7} {'roll':>7} {' '.join(f'{name:>14}' for name in names)}"
    lines = [
        f"{header}  {'error over the mission afterwards, nT: RMS':>40} {'worst':>8}",
        f"{'none yet':>{len(header)}}  {found.rms[0]:40.2f} {found.worst[0]:8.2f}",
    ]
    for number, run in enumerate(found.runs, 1):
        positions = " ".join(f"{value:14.3f}" for value in run.parameters)
        flown = f"{number:4} {run.pitch:7.1f} {run.roll:7.1f} {positions}"
        lines.append(f"{flown}  {found.rms[number]:40.2f} {found.worst[number]:8.2f}")
    return "\n".join([*lines, "each run covers all headings, as a spiral does; angles in degrees"])
