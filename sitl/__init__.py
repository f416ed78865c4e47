"""The other end of every line: a simulated world, and emulated devices with real protocols.

A :mod:`.scenario` describes the simulation. In its :mod:`.world` a vehicle (:mod:`.platform`) with an
:mod:`.instrument` flies a :mod:`.mission` along a :mod:`.trajectory`, or the way of a real log; the
:mod:`.twin` is all of them together, and its log a :mod:`.dataset`. :mod:`.inject` hides effects.
:mod:`.fluxgate` emulates the sensors' protocols, and :mod:`.replay` plays deployments to the bridge.
:mod:`.demo` does the main job.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sitl.dataset import segments
    from sitl.scenario import Scenario, load
    from sitl.twin import Twin, simulate, simulate_like

__all__ = ["Scenario", "Twin", "load", "segments", "simulate", "simulate_like"]

# loaded when first asked for: an emulated device needs neither scipy nor xarray
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
