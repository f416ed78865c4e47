"""Hide an effect in a simulated deployment, with finer physics than anyone would fit to it.

It shares nothing with the detector: heat soaks through a slab where the detector has two lags in series,
steel has a Preisach distribution where it has one play operator, currents flow in wires with a shape, filters
and converters are the instrument's own, the ionosphere has a spectrum. Each effect is one function of the
:class:`~.scene.Scene`, a size, and a random generator that draws its direction, place and time. An effect is
proportional to its size as far as physics allows. Properties of the vehicle or its instrument are drawn from
the seed of :class:`~.scene.HiddenEffect` alone, so they are the same on every deployment.
"""

from __future__ import annotations

from sitl.inject.catalogue import EFFECTS
from sitl.inject.measure import disturb
from sitl.inject.scene import HiddenEffect, Scene, furnish

__all__ = ["EFFECTS", "HiddenEffect", "Scene", "disturb", "furnish"]
