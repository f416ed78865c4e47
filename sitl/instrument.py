"""Simulate the instrument of the paper's section 3: fluxgate, RC filters, one multiplexed converter."""

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
    """Table ``[instrument]``: a three-axis fluxgate and its digitiser."""

    rate: Positive = 0.25
    """Rate of the readings, Hz."""
    scale: Vector = (1.0, 1.0, 1.0)
    offset: Vector = (0.0, 0.0, 0.0)
    """`scale`, `offset`: Gain and offset (nT) of each axis."""
    orthogonality: Vector = (0.0, 0.0, 0.0)
    """Differences of the angles xy, xz and yz from 90 deg, deg."""
    mounting: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch and heading of the sensor relative to the body, deg."""
    turn_on_sigma: NotNegative = 0.0
    """1-sigma of the offset's change at every power-on, nT on each axis."""
    power_on: tuple[float, ...] = ()
    """Times at which the instrument is power-cycled, s after the start."""
    offset_per_degree: Vector = (0.0, 0.0, 0.0)
    scale_per_degree: Vector = (0.0, 0.0, 0.0)
    """`offset_per_degree`, `scale_per_degree`: Temperature coefficients, nT/degC and 1/degC."""
    reference_temperature: float = 2.0
    """Temperature at which the temperature coefficients have no effect, degC."""
    start_temperature: float | None = None
    """Temperature of the fluxgate at the start, degC; None for the temperature of the water."""
    thermal_lag: NotNegative = 3600.0
    """Time constant with which the fluxgate's temperature follows the water's, s."""
    corner: NotNegative = 0.33
    """Corner frequency of the RC anti-alias filter, Hz; 0 for no filter."""
    channel_delay: Vector = (0.0, 0.0, 0.0)
    """Time from the triple's time until the converter samples each channel, s."""
    bits: Annotated[int, Meta(ge=2, le=32)] = 24
    full_scale: Positive = 100_000.0
    """`bits`, `full_scale`: Resolution of the converter, bits, and its range to either side of zero, nT."""
    noise_sigma: NotNegative = 1.0
    noise_memory: NotNegative = 0.0
    """`noise_sigma`, `noise_memory`: 1-sigma of a channel's noise (nT), and its correlation time in samples
    (0: white noise)."""

    def matrix(self) -> FloatArray:
        """Return the matrix (3, 3) from the field in body axes to the channels, without noise and offset.

        Its rows are the sensing axes: in sensor axes, x is the reference and y lies in the x-y plane. The
        rotation from body to sensor has the order 3-2-1.
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
        """Return the instrument's samples of a `field` (n, 3), nT in body axes, given every `step` s.

        `water` (n,) is the water temperature, degC. The samples are triples at `time` (m,), s after the first
        point; with the channel delays, they must lie within the grid. `rng` generates the offsets at power-on
        and the noise.
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
        """Return `field` (n, 3), nT, rounded to the converter's step and clipped to its range."""
        half = 2 ** (self.bits - 1)
        step = self.full_scale / half
        return np.asarray(np.clip(np.rint(field / step), -half, half - 1) * step)


@dataclass(frozen=True)
class Samples:
    """Samples of an :class:`Instrument`, at m times."""

    channels: FloatArray
    """Readings (m, 3), nT."""
    times: FloatArray
    """Time at which each channel was sampled (m, 3), s after the grid's first point."""
    temperature: FloatArray
    """Temperature of the fluxgate (m,), degC."""
    power_cycle: FloatArray
    """Number of power cycles before each sample (m,)."""


def rotation(roll: float | FloatArray, pitch: float | FloatArray, heading: float | FloatArray) -> Rotation:
    """Return the rotations from body axes to north-east-down axes; angles (n,) in deg, order 3-2-1.

    ``rotation(...).apply(field_ned, inverse=True)`` is the field in body axes.
    """
    return Rotation.from_euler(
        "ZYX", np.stack(np.broadcast_arrays(heading, pitch, roll), axis=-1), degrees=True
    )
