"""The causes: one small function each, with its physics, equation and source, and one row in a table.

Each takes the problem and returns candidates over a grid of its nonlinear parameters. Widths are plausible
sizes (1-sigma of a Gaussian prior): they set Occam's factor, not what can be found.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from magbridge.diagnose.causes.masses import actuator_order, hysteresis, unmodelled_actuator
from magbridge.diagnose.causes.reference import diurnal_variation, map_error, reference_bias
from magbridge.diagnose.causes.response import nonlinearity, saturation
from magbridge.diagnose.causes.telemetry import (
    current_field,
    pressure_offset,
    temperature_offset,
    temperature_scale,
)
from magbridge.diagnose.causes.time_dependent import interference_tone, offset_drift, offset_step
from magbridge.diagnose.causes.timing import channel_skew, clock_offset, eddy_current, filter_lag
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.problem import Problem
from magbridge.errors import PluginError
from magbridge.plugins import load, plugins

__all__ = ["CAUSES", "Cause", "known"]

GROUP = "magbridge.causes"
"""Entry points that add a cause: each is a :class:`Cause`, and its name is that of ``findings.json``."""


class Cause(NamedTuple):
    """A row of the table."""

    candidates: Callable[[Problem], list[Candidate]]
    """``Problem -> list of Candidate``."""
    needs: str
    """What a log must contain for it to be tested."""
    disambiguation: str
    """Manoeuvre that distinguishes the cause from its competing hypotheses."""
    meaning: str = ""
    """Meaning of the cause, as a clause."""
    family: str = ""
    """Causes of one family describe each other's remnants: they are one finding."""
    delays_telemetry: bool = False
    """Whether the effect is a delay of the telemetry, which ``[telemetry.NAME] delay`` corrects."""


CAUSES: dict[str, Cause] = {
    "temperature_offset": Cause(temperature_offset, "a temperature that varies", "pass one depth at two temperatures of the sensor, diving and climbing; or hold one depth for an hour after launch", "the sensor's zero shifts with temperature", family="temperature"),
    "temperature_scale": Cause(temperature_scale, "a temperature that varies", "roll about the field at two temperatures: a scale follows the axis' reading, an offset does not", "the sensor's sensitivity changes with temperature", family="temperature"),
    "offset_step": Cause(offset_step, "time", "log the power-cycle counter; fly one attitude before and after", "the sensor's zero jumped, as after a power cycle or a magnetic shock"),
    "offset_drift": Cause(offset_drift, "time", "return to one place and attitude hours later", "the sensor's zero creeps with time"),
    "current_field": Cause(current_field, "a current", "run the motor with its mass held, and hold the motor with its mass moved", "an electric current makes a field of its own"),
    "unmodelled_actuator": Cause(unmodelled_actuator, "the position of something that moves", "move it at one attitude", "something that moves carries iron, and the calibration does not know of it"),
    "actuator_order": Cause(actuator_order, "a calibration with parameters", "move one mass in small steps over its whole range at one attitude", "a mass that the calibration knows acts in a finer way than it describes", family="mass"),
    "hysteresis": Cause(hysteresis, "a calibration with parameters", "approach one position from both sides", "a mass acts differently depending on where it came from: play in its drive, or steel that stays magnetised"),
    "eddy_current": Cause(eddy_current, "turns", "reverse the turn", "currents that are induced while the vehicle turns make a field"),
    "channel_skew": Cause(channel_skew, "turns", "reverse the turn; roll about the axis that all delays share", "the sensor's three axes were not read when the log says"),
    "filter_lag": Cause(filter_lag, "masses that move while sampled, or the calibration's own runs", "change the corner of the filter, or step an actuator", "a filter delays the sensor's readings against the telemetry", family="mass"),
    "clock_offset": Cause(clock_offset, "a calibration with parameters that move while sampled", "move an actuator at constant attitude", "the clocks of sensor and telemetry differ", family="mass", delays_telemetry=True),
    "nonlinearity": Cause(nonlinearity, "attitudes that take an axis of the sensor through its range", "turn every axis of the sensor through the whole field", "the sensor's response bends"),
    "saturation": Cause(saturation, "an axis of the sensor near its end", "turn that axis away from the field: saturation occurs only near full scale", "an axis of the sensor clips near the end of its range"),
    "pressure_offset": Cause(pressure_offset, "depth or pressure that varies", "hold one depth for an hour: the temperature becomes constant, the pressure effect stays", "the sensor's zero shifts with depth or pressure"),
    "diurnal_variation": Cause(diurnal_variation, "at least two hours", "a base station ashore", "the Earth's field itself changed during the day", family="reference"),
    "map_error": Cause(map_error, "positions over some hundred metres", "cross the track again, at another depth too: an error of the map is the same on every pass at one depth", "the map or field model that served as the truth is wrong from place to place", family="reference"),
    "reference_bias": Cause(reference_bias, "a reference", "calibrate and survey at one place, next to a proton magnetometer", "the map or field model that served as the truth is wrong by a constant", family="reference"),
    "interference_tone": Cause(interference_tone, "even sampling", "change the sampling rate: an alias changes its frequency", "something disturbs the sensor periodically"),
}  # fmt: skip


def known() -> dict[str, Cause]:
    """Return the table of causes, with those that other packages add.

    PluginError: one cannot be imported, is not a cause, or has the name of an existing one.
    """
    added = {}
    for name, point in plugins(GROUP).items():
        cause = load(point)
        if not isinstance(cause, Cause) or name in CAUSES:
            wrong = "a cause of that name is there" if name in CAUSES else f"{point.value} is no Cause"
            raise PluginError(f"cause {name!r}", wrong)
        added[name] = cause
    return CAUSES | added
