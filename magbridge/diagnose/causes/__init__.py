"""The causes of error that a diagnosis tests: one class for each, with its equation in the docstring.

Start with :mod:`.base`, the interface. A package adds a cause by an entry point of :data:`GROUP`.
"""

from __future__ import annotations

from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.causes.instrument import (
    InterferenceTone,
    Nonlinearity,
    OffsetDrift,
    OffsetStep,
    Saturation,
)
from magbridge.diagnose.causes.masses import ActuatorOrder, Hysteresis, UnmodelledActuator
from magbridge.diagnose.causes.reference import DiurnalVariation, MapError, ReferenceBias
from magbridge.diagnose.causes.telemetry import (
    CurrentField,
    PressureOffset,
    TemperatureOffset,
    TemperatureScale,
)
from magbridge.diagnose.causes.timing import ChannelSkew, ClockOffset, EddyCurrent, FilterLag
from magbridge.errors import PluginError
from magbridge.plugins import load, plugins

__all__ = ["CAUSES", "Cause", "known"]

GROUP = "magbridge.causes"
"""Group of entry points that add a :class:`Cause`, under the cause's name in ``findings.json``."""

CAUSES: dict[str, Cause] = {
    cause.name: cause
    for cause in (
        TemperatureOffset(), TemperatureScale(), OffsetStep(), OffsetDrift(), CurrentField(),
        UnmodelledActuator(), ActuatorOrder(), Hysteresis(), EddyCurrent(), ChannelSkew(), FilterLag(),
        ClockOffset(), Nonlinearity(), Saturation(), PressureOffset(), DiurnalVariation(), MapError(),
        ReferenceBias(), InterferenceTone(),
    )
}  # fmt: skip


def known() -> dict[str, Cause]:
    """Return the causes by name: :data:`CAUSES`, and the causes that other packages add.

    PluginError: an added cause cannot be imported, is not a :class:`Cause`, or has the name of one here.
    """
    added = {}
    for name, point in plugins(GROUP).items():
        cause = load(point)
        if not isinstance(cause, Cause) or name in CAUSES:
            wrong = "a cause of that name is there" if name in CAUSES else f"{point.value} is no Cause"
            raise PluginError(f"cause {name!r}", wrong)
        added[name] = cause
    return CAUSES | added
