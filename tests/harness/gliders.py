"""Random gliders with moving dipoles: calibration runs (Table 1 of the paper) and a survey."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.result import Fit
from sitl.instrument import Instrument
from sitl.mission import LIMITS, CrissCross, Spirals
from sitl.platform import Vehicle, draw_vehicle
from sitl.signals import autoregressive
from sitl.trajectory import fly

FIELD_NED = np.array([16_200.0, -5_000.0, 49_200.0])
FIELD = float(np.linalg.norm(FIELD_NED))
MASSES = {0: (), 1: ("battpos",), 2: ("battpos", "ballast"), 3: ("battpos", "ballast", "rollpos")}


@dataclass(frozen=True)
class Glider:
    """Simulated vehicle with known parameters, its calibration runs and its survey."""

    vehicle: Vehicle
    runs: Observations
    survey: Observations
    quiet: np.ndarray
    """Readings of the survey without noise, (n, 3) in nT."""


Gliders = Callable[..., Glider]
"""Function ``glider(seed, masses, noise, memory)`` that returns the same glider for the same arguments."""


def make(seed: int, masses: int = 2, noise: float = 1.0, memory: float = 0.0) -> Glider:
    """Draw a glider; `noise` is the 1-sigma of a channel (nT), `memory` its correlation time in samples."""
    rng = np.random.default_rng([5, seed])
    names = MASSES[masses]
    vehicle = draw_vehicle(rng, names)
    instrument = Instrument(
        scale=tuple((1 + rng.normal(0, 0.003, 3)).tolist()),
        orthogonality=tuple(rng.normal(0, 0.2, 3).tolist()),
        offset=tuple(rng.normal(0, 60, 3).tolist()),
    )
    limits = {name: LIMITS[name] for name in {*names, "battpos", "ballast"}}
    parts = []
    for mission in (Spirals(), CrissCross(hours=3.0, pitch=(25.0, 2.5), roll=(1.0, 2.0))):
        legs = mission.legs(rng, limits)
        track = fly(legs, (1.4e9, 49.5, -57.9), 4.0, rng, limits=limits)
        angles = np.column_stack([track.roll, track.pitch, track.heading])
        body = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True).inv().apply(FIELD_NED)
        positions = {name: track.parameters[name] for name in names}
        true = vehicle.field(body, positions) @ instrument.matrix().T + np.array(instrument.offset)
        ends = np.cumsum([leg.duration for leg in legs])
        n = len(true)
        data = Observations(
            field=true + autoregressive(rng, true.shape, noise, memory),
            reference=np.full(n, FIELD),
            parameters=np.column_stack([*positions.values()]) if names else np.empty((n, 0)),
            names=names,
            units=tuple(limits[name].unit for name in names),
            runs=np.searchsorted(ends, track.elapsed, side="right"),
            time=track.start + track.elapsed,
            attitude=np.radians(angles),
            reference_ned=np.tile(FIELD_NED, (n, 1)),
        )
        parts.append((data, true))
    (runs, _), (survey, quiet) = parts
    return Glider(vehicle, runs, survey, quiet)


def codes(found: Fit) -> list[str]:
    """Return the codes of a fit's warnings."""
    return [warning.code for warning in found.warnings]
