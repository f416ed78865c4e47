"""Hide an effect in a simulated deployment, with finer physics than anyone would fit to it.

It shares nothing with the detector: heat soaks through a slab where the detector has two lags in series,
steel has a Preisach distribution where it has one play operator, currents flow in wires with a shape, filters
and converters are the instrument's own, the ionosphere has a spectrum. Each effect is one function of the
:class:`~.scene.Scene`, a size, and a random generator that draws its direction, place and time. An effect is
proportional to its size as far as physics allows. Properties of the vehicle or its instrument are drawn from
the seed of :class:`~.scene.Hidden` alone, so they are the same on every deployment.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sitl.inject import sensor, surroundings, vehicle
from sitl.inject.foreign import FOREIGN
from sitl.inject.measure import measure
from sitl.inject.scene import Effect, Hidden, Scene, furnish
from sitl.trajectory import Track
from sitl.twin import Twin

__all__ = ["EFFECTS", "FOREIGN", "Hidden", "Scene", "disturb", "furnish"]

EFFECTS: dict[str, Effect] = {
    "temperature_offset": sensor.heat_offset,
    "temperature_scale": sensor.heat_scale,
    "offset_step": sensor.jump,
    "offset_drift": sensor.creep,
    "current_field": vehicle.wires,
    "unmodelled_actuator": vehicle.magnet_on_fin,
    "actuator_order": vehicle.neighbours,
    "hysteresis": vehicle.preisach,
    "eddy_current": vehicle.ring,
    "channel_skew": sensor.multiplexed,
    "filter_lag": sensor.anti_alias,
    "clock_offset": sensor.late_stamps,
    "nonlinearity": sensor.core,
    "saturation": sensor.rail,
    "pressure_offset": vehicle.squeezed,
    "diurnal_variation": surroundings.ionosphere,
    "map_error": surroundings.bad_map,
    "reference_bias": surroundings.wrong_level,
    "interference_tone": surroundings.hum,
    "outliers": sensor.bit_flips,
}
"""Cause, by its public name -> the effect that is hidden."""


def disturb(
    twin: Twin, hidden: tuple[Hidden, ...], track: Track, when: NDArray[np.float64], seed: int = 0
) -> xr.Dataset:
    """Measure along `track` with `hidden` effects; without any, the furnished deployment alone.

    Parameters
    ----------
    twin : Twin
        The world, the vehicle and its instrument.
    hidden : tuple of Hidden
        By their names in :data:`EFFECTS` or :data:`FOREIGN`.
    track : Track
        As :meth:`~sitl.twin.Twin.fly` returns it.
    when : array (m,)
        s after the track's start; a few seconds short of its end.
    seed : int
        Of the telemetry that has nothing to do with the effects.

    Returns
    -------
    Dataset (time)
        As :meth:`~sitl.twin.Twin.measure`, with more telemetry. ``attrs["truth"]`` (JSON) holds what a
        perfect diagnosis would print of a single effect, where physics has such numbers.
    """
    return measure(EFFECTS | FOREIGN, twin, hidden, track, when, seed)
