"""The instrument chain of the paper's section 3: fluxgate, RC filter, one 24-bit converter for all three."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.config import NotNegative, Positive
from magbridge.toml import Table
from sitl.signals import autoregressive, first_order, first_order_at

__all__ = ["Instrument", "Samples", "rotation"]

Vector = tuple[float, float, float]


class Instrument(Table, frozen=True):
    """``[instrument]``: a three-axis fluxgate and its digitiser."""

    rate: Positive = 0.25
    """Rate of the readings, Hz."""
    scale: Vector = (1.0, 1.0, 1.0)
    offset: Vector = (0.0, 0.0, 0.0)
    """`scale`, `offset`: Gain of each axis, and nT."""
    orthogonality: Vector = (0.0, 0.0, 0.0)
    """deg by which the angles xy, xz, yz differ from 90."""
    mounting: Vector = (0.0, 0.0, 0.0)
    """deg roll, pitch, heading of the sensor in the body."""
    turn_on_sigma: NotNegative = 0.0
    """nT an axis; the offset changes at every power-on."""
    power_on: tuple[float, ...] = ()
    """s after the start at which the instrument is powered on again."""
    offset_per_degree: Vector = (0.0, 0.0, 0.0)
    scale_per_degree: Vector = (0.0, 0.0, 0.0)
    """`offset_per_degree`, `scale_per_degree`: nT/degC and 1/degC, about `reference_temperature`."""
    reference_temperature: float = 2.0
    """degC at which offset and scale are as given."""
    start_temperature: float | None = None
    """degC of the fluxgate at the start; None: the temperature of the water."""
    thermal_lag: NotNegative = 3600.0
    """Time constant with which the fluxgate's temperature follows the water's, s."""
    corner: NotNegative = 0.33
    """Hz of the RC anti-alias filter; 0 leaves it out."""
    channel_delay: Vector = (0.0, 0.0, 0.0)
    """s after the triple's time at which the converter reaches each channel."""
    bits: Annotated[int, Meta(ge=2, le=32)] = 24
    full_scale: Positive = 100_000.0
    """`bits`, `full_scale`: float: Converter: bits, and nT either side of zero."""
    noise_sigma: NotNegative = 1.0
    noise_memory: NotNegative = 0.0
    """`noise_sigma`, `noise_memory`: nT of a channel's noise, and samples over which its correlation falls by
    e (0: white)."""

    def matrix(self) -> FloatArray:
        """Return the matrix (3, 3) from the field in body axes to the channels, without noise and offset.

        Rows are the sensing axes in sensor axes: x is the reference, y lies in the x-y plane. The rotation
        from body to sensor follows the 3-2-1 order.
        """
        xy, xz, yz = np.radians(self.orthogonality)
        axes = np.array(
            [
                [1.0, 0.0, 0.0],
                [np.sin(xy), np.cos(xy), 0.0],
                [np.sin(xz), np.sin(yz), np.sqrt(1 - np.sin(xz) ** 2 - np.sin(yz) ** 2)],
            ]
        )
        return np.asarray(np.diag(self.scale) @ axes @ rotation(*self.mounting).as_matrix().T)

    def measure(
        self, field: FloatArray, water: FloatArray, step: float, time: FloatArray, rng: np.random.Generator
    ) -> Samples:
        """Measure a `field` (n, 3), nT in body axes at the sensor, given every `step` s.

        `water` (n,), degC, is around the instrument; triples are taken at `time` (m,), s after the first
        point, inside the grid with channel delays included. `rng` is that of the offsets at power-on and of
        the noise.
        """
        temperature = self.temperature(water, step)
        warm = (temperature - self.reference_temperature)[:, None]
        cycle = np.searchsorted(np.asarray(self.power_on), step * np.arange(len(field)), side="right")
        turn_on = rng.normal(0, self.turn_on_sigma, (len(self.power_on) + 1, 3))
        analogue = field @ self.matrix().T
        analogue *= 1 + warm * np.asarray(self.scale_per_degree)
        analogue += np.asarray(self.offset) + warm * np.asarray(self.offset_per_degree) + turn_on[cycle]

        time_constant = 1 / (2 * np.pi * self.corner) if self.corner else 0.0
        filtered = first_order(analogue, step, time_constant)
        channels = autoregressive(rng, (len(time), 3), self.noise_sigma, self.noise_memory)
        for axis, delay in enumerate(self.channel_delay):
            channels[:, axis] += first_order_at(
                analogue[:, axis], filtered[:, axis], step, time_constant, time + delay
            )
        grid = step * np.arange(len(field))
        return Samples(
            channels=self.digitise(channels),
            times=time[:, None] + np.asarray(self.channel_delay),
            temperature=np.interp(time, grid, temperature),
            power_cycle=np.searchsorted(np.asarray(self.power_on), time, side="right").astype(np.float64),
        )

    def temperature(self, water: FloatArray, step: float) -> FloatArray:
        """Return the fluxgate's temperature (n,), degC, in `water` (n,), degC, sampled every `step` s."""
        return first_order(water, step, self.thermal_lag, self.start_temperature)

    def digitise(self, field: FloatArray) -> FloatArray:
        """Return `field` (n, 3), nT, as the converter gives it: rounded to its step, clipped at its ends."""
        half = 2 ** (self.bits - 1)
        step = self.full_scale / half
        return np.asarray(np.clip(np.rint(field / step), -half, half - 1) * step)


@dataclass(frozen=True)
class Samples:
    """What an :class:`Instrument` gave."""

    channels: FloatArray
    """(m, 3), nT."""
    times: FloatArray
    """(m, 3), s after the grid's first point, when each channel was sampled."""
    temperature: FloatArray
    """(m,), degC at the fluxgate."""
    power_cycle: FloatArray
    """(m,): How many times it was powered on again."""


def rotation(roll: float | FloatArray, pitch: float | FloatArray, heading: float | FloatArray) -> Rotation:
    """Return the rotations that take body vectors to the world's axes, angles (n,) in deg, order 3-2-1.

    ``rotation(...).apply(field_ned, inverse=True)`` is the field in body axes.
    """
    return Rotation.from_euler(
        "ZYX", np.stack(np.broadcast_arrays(heading, pitch, roll), axis=-1), degrees=True
    )
