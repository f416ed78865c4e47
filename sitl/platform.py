"""Simulate the vehicle's magnetism: fixed iron, and moving masses, which are dipoles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import forward
from magbridge.calibration.model import Calibration
from magbridge.toml import Table
from sitl.world import MU_0_OVER_4_PI, dipole_field

__all__ = [
    "HARD_IRON", "MOMENT", "MOUNTINGS", "SOFT_IRON", "VOLUME_SPREAD", "Calibrated", "Mass", "Matrix",
    "Mounting", "Vehicle", "draw_vehicle",
]  # fmt: skip

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class Mounting(NamedTuple):
    """Usual place of a kind of mass in the vehicle, and its motion."""

    at: Vector
    travel: Vector
    """`at`, `travel`: Position relative to the sensor at parameter 0 (m, body axes), and displacement per
    unit of the parameter (m)."""
    low: float
    high: float
    rate: float
    """`low`, `high`, `rate`: Limits of the parameter (units), and its speed (units/s)."""
    unit: str


MOUNTINGS: dict[str, Mounting] = {
    # a 200 m electric glider with the sensor in its payload bay: battery pack aft, ballast pump in the nose
    "battpos": Mounting((-0.50, 0.0, 0.05), (0.0254, 0.0, 0.0), -1.0, 1.0, 0.05, "in"),
    "ballast": Mounting((0.60, 0.0, 0.0), (1e-4, 0.0, 0.0), -230.0, 230.0, 12.0, "cm3"),
    "rollpos": Mounting((-0.65, 0.0, 0.04), (0.0, 0.01, 0.0), -3.0, 3.0, 0.3, "cm"),
    "aftpos": Mounting((-0.80, 0.0, 0.0), (0.01, 0.0, 0.0), -4.0, 4.0, 0.3, "cm"),
}


HARD_IRON, SOFT_IRON = 1500.0, 0.01
"""1-sigma on each axis of a random vehicle's hard iron (nT) and soft iron (nT per nT)."""
MOMENT = 3.0
"""1-sigma on each axis of a random mass's permanent moment, A m²."""
VOLUME, VOLUME_SPREAD = (2e-3, 1e-3, 1e-3), 0.3
"""Median of apparent susceptibility times volume along each axis (m³), and the 1-sigma of its logarithm."""
PLACE_SPREAD = (0.06, 0.03, 0.03)
"""1-sigma of a random mass's position about :data:`MOUNTINGS`, m."""


class Mass(Table, frozen=True):
    """Table ``[vehicle.mass.NAME]``: a mass that the parameter NAME moves."""

    at: Vector
    travel: Vector
    """`at`, `travel`: Position relative to the sensor at parameter 0 (m, body axes), and displacement per
    unit of the parameter (m)."""
    moment: Vector
    """Permanent magnetic moment, A m²."""
    volume: Vector = (0.0, 0.0, 0.0)
    """Apparent susceptibility times volume along each axis, m³: the induced moment is ``volume * B / µ0``."""

    def field(self, ambient: FloatArray, position: FloatArray) -> FloatArray:
        r"""Return the mass's field at the sensor (n, 3), nT in body axes.

        `ambient` (n, 3), nT, is the Earth's field in body axes, `position` (n,) the parameter.

        Notes
        -----
        :math:`\mathbf m = \mathbf m_0 + \chi V \mathbf B / \mu_0`, with B the field without the mass.
        With µ0/4π = 100 nT m/A, :math:`B[nT] / \mu_0 = B[nT] / (400 \pi)`.
        """
        r = -(np.asarray(self.at) + position[:, None] * np.asarray(self.travel))
        m = np.asarray(self.moment) + np.asarray(self.volume) * ambient / (4 * np.pi * MU_0_OVER_4_PI)
        return dipole_field(r, m)


class Vehicle(Table, frozen=True):
    """Table ``[vehicle]``: a vehicle of given magnetism."""

    hard_iron: Vector = (0.0, 0.0, 0.0)
    """Permanent field of all parts that do not move, nT, body axes."""
    soft_iron: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """Field that fixed iron adds per unit of the Earth's field, body axes."""
    mass: dict[str, Mass] = msgspec.field(default_factory=dict)
    """Moving masses, by the name of the parameter that moves each."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that :meth:`field` needs."""
        return tuple(self.mass)

    def field(
        self,
        ambient: FloatArray,
        channels: Mapping[str, FloatArray],
        time: FloatArray | None = None,  # noqa: ARG002
    ) -> FloatArray:
        """Return the field at the sensor, (n, 3) nT in body axes.

        `ambient` (n, 3), nT, is the Earth's field in body axes; `channels` has the positions (n,) of every
        mass. Iron does not depend on the time.
        """
        fixed = ambient + np.asarray(self.hard_iron) + ambient @ np.asarray(self.soft_iron).T
        moving = (mass.field(ambient, channels[name]) for name, mass in self.mass.items())
        return sum(moving, start=fixed)


@dataclass(frozen=True)
class Calibrated:
    """Vehicle whose magnetism is the forward model of a calibration."""

    calibration: Calibration

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that :meth:`field` needs: mass positions, and the channels of the effects."""
        return self.calibration.channels

    def field(self, ambient: FloatArray, channels: Mapping[str, FloatArray], time: FloatArray) -> FloatArray:
        """Return the field at the sensor like :meth:`Vehicle.field`; `time` (n,) is s since 1970."""
        sampled = np.reshape([channels[name] for name in self.channels], (-1, len(time))).T
        return forward(self.calibration, ambient, sampled, time)


def draw_vehicle(rng: np.random.Generator, masses: Sequence[str] = ("battpos", "ballast")) -> Vehicle:
    """Draw a random vehicle with these moving masses (keys of :data:`MOUNTINGS`).

    The magnitudes are typical of a small glider. Fixed iron has 1,500 nT and 1 % on each axis. A mass has a
    permanent moment of 3 A m² on each axis: ten kilograms of alkaline cells contain two or three kilograms of
    steel, 3e-4 m³, at some 10 kA/m. Its apparent susceptibility times volume is 2 litres along its length and
    half as much across (cans with a demagnetising factor near 0.1). Its position is within centimetres of the
    usual one. A nominal calibration of such a vehicle over the spirals of the paper's Table 1 has an error of
    about 150 nT, like the paper's.
    """
    iron = rng.normal(0, SOFT_IRON, (3, 3))
    return Vehicle(
        hard_iron=_vector(rng.normal(0, HARD_IRON, 3)),
        soft_iron=(_vector(iron[0]), _vector(iron[1]), _vector(iron[2])),
        mass={
            name: Mass(
                at=_vector(np.asarray(MOUNTINGS[name].at) + rng.normal(0, PLACE_SPREAD)),
                travel=MOUNTINGS[name].travel,
                moment=_vector(rng.normal(0, MOMENT, 3)),
                volume=_vector(np.array(VOLUME) * np.exp(rng.normal(0, VOLUME_SPREAD, 3))),
            )
            for name in masses
        },
    )


def _vector(values: FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
