"""Which calibration runs to fly next, from a deployment that flies as the mission will."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from magbridge.calibration.fitting.mission import Mission
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.calibration.planning.plan import Limits, Plan, expected_calibration, plan, settled, trim_of
from magbridge.calibration.planning.survey_patterns import Proposal, propose
from magbridge.columns import require_units
from magbridge.errors import CalibrationError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["facts", "flight_plan", "summary", "survey_plan"]


def flight_plan(calibration: Calibration, mission: xr.Dataset, *, runs: int = 10, roll: float = 10.0) -> Plan:
    """Choose runs for a mission.

    `calibration`: calibration so far. `mission`: Attitude, position and masses as the mission will have
    them; magnetometer columns are not needed. `runs`: how many to choose. `roll`: deg, the largest bank
    either way.

    CalibrationError: the mission has no attitude or position. FormatError: it lacks a parameter of the
    calibration, or has it in another unit.
    """
    require_units(mission, calibration.units)
    names = tuple(calibration.units)
    data = _to_be_flown(mission, names)
    if data.reference_ned is None:
        raise CalibrationError("the mission needs latitude and longitude, to know the Earth's field there")
    # runs at trims that the vehicle can fly: those that the mission shows
    flown = settled(data, calibration.parameters) if names else None
    limits = Limits(roll=(-roll, roll), pitch_at=trim_of(data), flown=flown)
    return plan(
        calibration,
        Mission.from_observations(data),
        np.nanmean(data.reference_ned, axis=0),
        limits,
        runs=runs,
    )


def survey_plan(
    calibration: Calibration | None,
    mission: xr.Dataset,
    parameters: tuple[str, ...] = (),
    *,
    hours: float,
    roll: float = 10.0,
) -> list[Proposal]:
    """Propose self-calibrating surveys of `hours`; arguments as for :func:`flight_plan`.

    Without a calibration they are for an unknown vehicle, whose masses' positions are `parameters`.

    CalibrationError, FormatError: as :func:`flight_plan`.
    """
    if calibration is not None:
        require_units(mission, calibration.units)
        parameters = tuple(calibration.units)
    data = _to_be_flown(mission.drop_vars("reference_field", errors="ignore"), parameters)
    # an unknown vehicle has the expected calibration, with the uncertainty of its prior
    if calibration is None:
        calibration = expected_calibration(data.ranges(), float(np.median(data.reference)))
    return propose(calibration, data, hours=hours, roll=roll)


def _to_be_flown(mission: xr.Dataset, names: tuple[str, ...]) -> Observations:
    """Return a mission's samples; what the magnetometer will read is of no account."""
    some = ("time", np.ones(mission.sizes["time"]))  # zeros would count as missing
    return observations(mission.assign({f"mag_{axis}": some for axis in "xyz"}), names)


def facts(found: Plan, calibration: Calibration) -> dict[str, Any]:
    """Return a plan as plain values."""
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
    """Return a plan as a table: the runs in order of worth, and the error expected after each."""
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
