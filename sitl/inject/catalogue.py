"""The effects that a diagnosis has a name for."""

from __future__ import annotations

from sitl.inject import sensor, surroundings, vehicle
from sitl.inject.scene import Effect

__all__ = ["EFFECTS"]

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
