"""What changes on a vehicle after its calibration, for :mod:`live`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

__all__ = ["CHANGES", "MASSES", "hours"]

MASSES = ("battpos", "ballast")
Change = Callable[[xr.Dataset, np.random.Generator, float], np.ndarray]
"""The log, a generator, and how many times the noise: the field added to the channels (n, 3), nT."""


def direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def hours(log: xr.Dataset) -> np.ndarray:
    time = log["time"].to_numpy()
    return np.asarray((time - time[0]) / 3600.0)


def nothing(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:  # noqa: ARG001
    return np.zeros((log.sizes["time"], 3))


def turn_on(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    return np.tile(size * direction(rng), (log.sizes["time"], 1))


def bolt(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    return np.asarray((hours(log) > 0.4 * hours(log)[-1])[:, None] * size * direction(rng))


def drift(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    later = np.maximum(hours(log) - 0.2 * hours(log)[-1], 0.0)
    return np.asarray((later / later[-1])[:, None] * 3.0 * size * direction(rng))


def warming(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """From -10 to +2 degC as the vehicle is launched, within half an hour, as in the paper's trial 1."""
    warmer = 12.0 * (1.0 - np.exp(-hours(log) / 0.5))
    log["sensor_temperature"] = "time", -10.0 + warmer
    return np.asarray((warmer / 12.0)[:, None] * 3.0 * size * direction(rng))


def pump(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """On for two minutes of every ten, from the middle of the survey with another wiring."""
    current = 2.0 * ((hours(log) * 6.0) % 1.0 < 0.2)
    log["pump_current"] = "time", current, {"units": "A"}
    return np.asarray((current * (hours(log) > 0.4 * hours(log)[-1]))[:, None] * 0.5 * size * direction(rng))


def clock(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """From 40 % of the survey on, the masses' telemetry is late by half of `size`, in s."""
    time = log["time"].to_numpy()
    later = hours(log) > 0.4 * hours(log)[-1]
    for name in MASSES:
        values = log[name].to_numpy()
        log[name] = "time", np.where(later, np.interp(time - 0.5 * size, time, values), values)
    return nothing(log, rng, size)


def sheet(log: xr.Dataset, rng: np.random.Generator, size: float) -> np.ndarray:
    """From 40 % of the survey on, another sheet of the map is used, whose level is another one."""
    log["reference_error"] = "time", 3.0 * size * (hours(log) > 0.4 * hours(log)[-1])
    return nothing(log, rng, size)


CHANGES: dict[str, tuple[Change, str, float]] = {
    "nothing": (nothing, "", 0.0),
    "turn-on step": (turn_on, "offset_step", 0.0),
    "bolt magnetised": (bolt, "offset_step", 0.4),
    "drift": (drift, "offset_drift", 0.2),
    "warming (trial 1)": (warming, "temperature_offset", 0.0),
    "pump": (pump, "current_field", 0.4),
    "clock": (clock, "clock_offset", 0.4),
    "map": (sheet, "map_error", 0.4),
    "straight over rock": (nothing, "", 0.0),
}
"""Name -> the change, its cause, and from which share of the survey on."""
