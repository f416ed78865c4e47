"""Simulation of deployments, and emulation of the bridge's devices with their real protocols.

A :mod:`.scenario` describes the simulation. In its :mod:`.world` a vehicle (:mod:`.platform`) with an
:mod:`.instrument` flies a :mod:`.mission` along a :mod:`.trajectory`, or along the track of a real log. The
:mod:`.twin` combines them and measures a deployment, which is a :mod:`.dataset`. :mod:`.inject` adds hidden
effects. :mod:`.fluxgate` emulates the sensors' protocols, and :mod:`.replay` sends deployments to the bridge.
:mod:`.demo` runs all steps from simulation to correction.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sitl.dataset import segments
    from sitl.scenario import Scenario, load
    from sitl.twin import Twin, simulate, simulate_like

__all__ = ["Scenario", "Twin", "load", "segments", "simulate", "simulate_like"]

# loaded on first use, because an emulated device needs neither scipy nor xarray
_HOMES = {
    "Scenario": "sitl.scenario",
    "Twin": "sitl.twin",
    "load": "sitl.scenario",
    "segments": "sitl.dataset",
    "simulate": "sitl.twin",
    "simulate_like": "sitl.twin",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
