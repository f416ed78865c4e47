"""Telemetry that is late against the sensor: found where a mass moves, and offered as a delay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr
from posed import FIELD, T0, calibrated, walk

from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose

INTERVAL_S, IRON_NT = 4.0, np.array([300.0, -200.0, 500.0])
MASS_CAUSES = ("clock_offset", "filter_lag", "actuator_order", "hysteresis", "temperature_offset")


def flight(delay: float, cubic: float, seed: int) -> xr.Dataset:
    """A log of a mass that moves now and then: its telemetry is late, and its iron acts with its cube."""
    rng, n = np.random.default_rng(seed), 1500
    time = INTERVAL_S * np.arange(n)
    stops = np.cumsum(rng.uniform(120.0, 300.0, 60))
    knots = np.sort(np.concatenate([stops, stops + 40.0]))
    position = np.repeat(rng.uniform(-1.0, 1.0, 61), 2)[1:-1]

    def mass(t: np.ndarray) -> np.ndarray:
        return np.interp(t, knots, position)

    direction = walk(n, rng)
    field = FIELD * direction / np.linalg.norm(direction, axis=1)[:, None]
    acts = mass(time)[:, None] * IRON_NT + cubic * mass(time)[:, None] ** 3
    raw = field + acts + rng.normal(0.0, 1.0, (n, 3))
    columns = {
        f"mag_{axis}": ("time", values, {"units": "nT"}) for axis, values in zip("xyz", raw.T, strict=True)
    }
    columns |= {
        "p": ("time", mass(time - delay), {"units": "in"}),
        "reference_field": ("time", np.full(n, FIELD), {"units": "nT"}),
        "sensor_temperature": ("time", 10.0 + rng.normal(0.0, 0.01, n).cumsum(), {"units": "degC"}),
    }
    return xr.Dataset(columns, {"time": T0 + time}, {"source": "made"})


def named(log: xr.Dataset) -> list[dict[str, Any]]:
    coefficients = np.concatenate([np.zeros(15), IRON_NT])
    table = {name: CAUSES[name] for name in MASS_CAUSES}
    return findings(diagnose([log], calibrated(coefficients, 0.01), causes=table))["findings"]


@pytest.mark.parametrize("delay", [0.6, 7.0])
def test_late_telemetry_is_offered_as_a_delay(delay: float) -> None:
    (finding,) = named(flight(delay, 0.0, 3))
    assert finding["cause"] == "clock_offset"
    assert "actuator_order" not in {other["cause"] for other in finding["alternatives"]}
    assert finding["configuration"]["telemetry"]["p"]["delay"] == pytest.approx(delay, rel=0.15)


def test_a_finer_action_of_the_mass_is_not_taken_for_a_delay() -> None:
    (finding,) = named(flight(0.0, 20.0, 4))
    assert (finding["cause"], finding["configuration"]) == ("actuator_order", None)
