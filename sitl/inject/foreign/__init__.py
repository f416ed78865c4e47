"""Effects that are none of the table's causes.

A diagnosis has no name for them, and is to say so. Like the causes in :mod:`sitl.inject`, each is one
function of the scene, a size and a random generator.
"""

from __future__ import annotations

from sitl.inject.foreign import sensor, surroundings, vehicle
from sitl.inject.scene import Effect

__all__ = ["FOREIGN"]

FOREIGN: dict[str, Effect] = {
    "relay": vehicle.relay,
    "ship": surroundings.ship,
    "pan": vehicle.pan,
    "loose": vehicle.loose,
    "corrosion": vehicle.corrosion,
    "pulsation": surroundings.pulsation,
    "needle": vehicle.needle,
    "thermostat": vehicle.thermostat,
    "perming": sensor.perming,
    "staircase": sensor.staircase,
    "swell": surroundings.swell,
    "cargo": vehicle.cargo,
    "contact": vehicle.contact,
    "strobe": vehicle.strobe,
    "storm": surroundings.storm,
    "rotor": vehicle.rotor,
    "viscous": vehicle.viscous,
    "brownout": sensor.brownout,
    "mains": surroundings.mains,
    "slip": vehicle.slip,
    "motional": vehicle.motional,
    "leak": vehicle.leak,
    "ranges": sensor.ranges,
    "sag": sensor.sag,
    "crossover": sensor.crossover,
    "popcorn": sensor.popcorn,
    "discharge": vehicle.discharge,
    "towed": vehicle.towed,
    "sunlit": vehicle.sunlit,
    "eccentric": vehicle.eccentric,
    "astray": surroundings.astray,
    "trailing": vehicle.trailing,
    "compliant": vehicle.compliant,
    "restart": sensor.restart,
    "whistle": sensor.whistle,
    "yielding": vehicle.yielding,
    "afterglow": vehicle.afterglow,
    "mast": sensor.mast,
    "annealed": sensor.annealed,
    "dynamo": surroundings.dynamo,
    "hvdc": surroundings.hvdc,
    "dew": sensor.dew,
    "sampler": vehicle.sampler,
    "substorm": surroundings.substorm,
    "litter": surroundings.litter,
    "stuck": sensor.stuck,
    "sounder": vehicle.sounder,
    "gradient": sensor.gradient,
    "squeezed": sensor.squeezed,
    "flare": surroundings.flare,
    "swarf": vehicle.swarf,
    "ageing": sensor.ageing,
    "crossfield": sensor.crossfield,
    "railway": surroundings.railway,
    "rudder": vehicle.rudder,
    "latch": vehicle.latch,
    "recovery": vehicle.recovery,
    "clamp": sensor.clamp,
    "seiche": surroundings.seiche,
    "accumulator": vehicle.accumulator,
    "modem": vehicle.modem,
    "rezero": sensor.rezero,
    "pipeline": surroundings.pipeline,
    "backdriven": vehicle.backdriven,
    "microphonic": sensor.microphonic,
    "soliton": surroundings.soliton,
    "escort": surroundings.escort,
}
"""Effect, by its name."""
