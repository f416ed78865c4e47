"""The bridge on the MAVLink side: a component without port or clock."""

from __future__ import annotations

from magbridge.link.component import Component
from magbridge.link.message_rates import check_publish
from magbridge.link.parameters import Parameters, Tunable, alignment, telemetry_ages
from magbridge.link.telemetry import TelemetryMap

__all__ = [
    "Component", "Parameters", "TelemetryMap", "Tunable", "alignment", "check_publish", "telemetry_ages",
]  # fmt: skip
