"""The vehicle's own magnetism: fixed iron, and moving masses, each a dipole."""

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
    """Where a kind of mass usually sits, and how it moves."""

    at: Vector
    travel: Vector
    """`at`, `travel`: m from the sensor in body axes when the parameter is 0, and m per unit of the
    parameter."""
    low: float
    high: float
    rate: float
    """`low`, `high`, `rate`: The vehicle's limits, units and units/s."""
    unit: str


MOUNTINGS: dict[str, Mounting] = {
    # a 200 m electric glider with the sensor in its payload bay: battery pack aft, ballast pump in the nose
    "battpos": Mounting((-0.50, 0.0, 0.05), (0.0254, 0.0, 0.0), -1.0, 1.0, 0.05, "in"),
    "ballast": Mounting((0.60, 0.0, 0.0), (1e-4, 0.0, 0.0), -230.0, 230.0, 12.0, "cm3"),
    "rollpos": Mounting((-0.65, 0.0, 0.04), (0.0, 0.01, 0.0), -3.0, 3.0, 0.3, "cm"),
    "aftpos": Mounting((-0.80, 0.0, 0.0), (0.01, 0.0, 0.0), -4.0, 4.0, 0.3, "cm"),
}


HARD_IRON, SOFT_IRON = 1500.0, 0.01
"""1-sigma on each axis of a drawn vehicle's fixed iron: nT, and nT per nT."""
MOMENT = 3.0
"""A m², 1-sigma an axis of a drawn mass."""
VOLUME, VOLUME_SPREAD = (2e-3, 1e-3, 1e-3), 0.3
"""m³, apparent susceptibility times volume along each axis, and the spread of its logarithm."""
PLACE_SPREAD = (0.06, 0.03, 0.03)
"""1-sigma of where a drawn mass stands about :data:`MOUNTINGS`, m."""


class Mass(Table, frozen=True):
    """``[vehicle.mass.NAME]``: a mass that the parameter NAME moves."""

    at: Vector
    travel: Vector
    """`at`, `travel`: m from the sensor in body axes when the parameter is 0, and m per unit of the
    parameter."""
    moment: Vector
    """A m², the permanent magnetisation."""
    volume: Vector = (0.0, 0.0, 0.0)
    """m³, apparent susceptibility times volume along each axis: the induced moment is ``volume * B / µ0``."""

    def field(self, ambient: FloatArray, position: FloatArray) -> FloatArray:
        r"""Return the mass's field at the sensor (n, 3), nT in body axes.

        `ambient` (n, 3), nT, is the Earth's field in body axes, `position` (n,) the parameter.

        Notes
        -----
        :math:`\mathbf m = \mathbf m_0 + \chi V \mathbf B / \mu_0`, in the field that would be there without
        the mass; with µ0/4π = 100 nT m/A, :math:`B[nT] / \mu_0 = B[nT] / (400 \pi)`.
        """
        r = -(np.asarray(self.at) + position[:, None] * np.asarray(self.travel))
        m = np.asarray(self.moment) + np.asarray(self.volume) * ambient / (4 * np.pi * MU_0_OVER_4_PI)
        return dipole_field(r, m)


class Vehicle(Table, frozen=True):
    """``[vehicle]``: a vehicle whose magnetism is known."""

    hard_iron: Vector = (0.0, 0.0, 0.0)
    """Field of all parts that do not move, nT."""
    soft_iron: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """Field that fixed iron adds per unit of the Earth's field, body axes."""
    mass: dict[str, Mass] = msgspec.field(default_factory=dict)
    """By the name of the parameter that moves it."""

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

        `ambient` (n, 3), nT, is the Earth's field in body axes; `channels` (n,) each has the position of
        every mass. Iron does not depend on the time.
        """
        fixed = ambient + np.asarray(self.hard_iron) + ambient @ np.asarray(self.soft_iron).T
        moving = (mass.field(ambient, channels[name]) for name, mass in self.mass.items())
        return sum(moving, start=fixed)


@dataclass(frozen=True)
class Calibrated:
    """A vehicle described by a calibration: the calibration's forward model in place of iron."""

    calibration: Calibration

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that :meth:`field` needs: masses, and the channels of the effects."""
        return self.calibration.channels

    def field(self, ambient: FloatArray, channels: Mapping[str, FloatArray], time: FloatArray) -> FloatArray:
        """Return the field at the sensor (n, 3) as :meth:`Vehicle.field`; `time` (n,) is s since 1970."""
        sampled = np.reshape([channels[name] for name in self.channels], (-1, len(time))).T
        return forward(self.calibration, ambient, sampled, time)


def draw_vehicle(rng: np.random.Generator, masses: Sequence[str] = ("battpos", "ballast")) -> Vehicle:
    """Draw a vehicle with these moving masses (keys of :data:`MOUNTINGS`).

    The sizes are those of a small glider. Fixed iron: 1,500 nT and 1 % an axis. A mass: 3 A m² an axis left
    by handling (ten kilograms of alkaline cells hold two or three kilograms of steel, 3e-4 m³, at some
    10 kA/m), and an apparent susceptibility times volume of 2 litres along its length, half that across
    (cans with a demagnetising factor near 0.1). It stands within centimetres of where its kind usually
    stands. A nominal calibration of such a vehicle over the spirals of the paper's Table 1 leaves about
    150 nT, as the paper's did.
    """
    iron = rng.normal(0, SOFT_IRON, (3, 3))
    return Vehicle(
        hard_iron=_vector(rng.normal(0, HARD_IRON, 3)),
        soft_iron=(_vector(iron[0]), _vector(iron[1]), _vector(iron[2])),
        mass={name: _draw_mass(rng, MOUNTINGS[name]) for name in masses},
    )


def _draw_mass(rng: np.random.Generator, mounting: Mounting) -> Mass:
    return Mass(
        at=_vector(np.asarray(mounting.at) + rng.normal(0, PLACE_SPREAD)),
        travel=mounting.travel,
        moment=_vector(rng.normal(0, MOMENT, 3)),
        volume=_vector(np.array(VOLUME) * np.exp(rng.normal(0, VOLUME_SPREAD, 3))),
    )


def _vector(values: FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
