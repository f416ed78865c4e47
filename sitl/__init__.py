"""The simulated world: what magbridge is tested, demonstrated and doubted with."""

from __future__ import annotations

from sitl.columns import segments
from sitl.like import simulate_like
from sitl.scenario import Scenario, load
from sitl.twin import Twin, simulate

__all__ = ["Scenario", "Twin", "load", "segments", "simulate", "simulate_like"]
