"""Connect each driver to its emulated instrument."""

from __future__ import annotations

from typing import Any

from old_twinleaf import open_old_twinleaf

from magbridge.sensors import Driver, open_driver
from sitl.fluxgate import Encoder, open_encoder

__all__ = ["CASES", "instrument"]

LINE = ["time", "x", "y", "z", "temperature", "supply", "sequence", "power_cycle"]
NMEA = {"columns": LINE, "separator": ",", "prefix": "$PMAG,", "checksum": "nmea", "sequence_modulo": 256}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "digitizer": ("digitizer", {"sensitivity": 5e-5}),
    "digitizer, gain 4": ("digitizer", {"sensitivity": 2e-5, "gain": 4.0}),
    "hmr2300 binary": ("hmr2300", {"output": "binary"}),
    "hmr2300 ascii": ("hmr2300", {"output": "ascii", "device": 12}),
    "rm3100": ("rm3100", {"cycle_count": 400}),
    "twinleaf 2": ("twinleaf", {"temperature": "therm"}),
    "twinleaf 2 behind a hub, µT": ("twinleaf", {"route": "/0/2", "unit": "uT"}),
    "twinleaf 1": ("twinleaf", {"route": "/0/2", "temperature": "therm"}),
    "ascii nmea": ("ascii", NMEA),
    "ascii keys": ("ascii", {"columns": ["x", "y", "z", "time"], "keys": ["rx", "ry", "rz", "t"]}),
    "ascii gauss": ("ascii", {"columns": ["x", "y", "z", "-", "*"], "unit": "G"}),
    "ascii range": ("ascii", {"columns": ["x", "y", "z", "temperature"], "unit": "G", "range": 65_000.0}),
    "ascii counts": ("ascii", {"unit": "counts", "scale": 0.5, "terminator": "\r"}),
}
"""Driver and its options for each case."""


def instrument(case: str, rate: float = 10.0) -> tuple[Driver, Encoder]:
    """Return a driver and its emulated instrument (readings at a rate, Hz), both started."""
    name, options = CASES[case]
    is_old = case == "twinleaf 1"
    encoder = open_old_twinleaf(options, rate) if is_old else open_encoder(name, options, rate=rate)
    driver = open_driver(name, options)
    for command in driver.start():
        assert driver.feed(encoder.feed(command)) == []
    assert encoder.streaming
    return driver, encoder
