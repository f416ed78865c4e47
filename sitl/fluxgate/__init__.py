"""Emulated instruments: the inverse of each driver, in the instrument's own bytes.

An encoder quantises and saturates as the instrument does, counts its readings, and answers what the driver
sends, so that a program behind a pty cannot distinguish it from the real one. Other packages add theirs by
an entry point in the group ``magbridge.encoders``: the driver's name, and a class like :class:`Encoder`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magbridge.errors import ConfigError
from magbridge.plugins import load, plugins
from magbridge.toml import convert
from sitl.fluxgate.ascii import AsciiEncoder
from sitl.fluxgate.digitizer import DigitizerEncoder
from sitl.fluxgate.encoder import Encoder
from sitl.fluxgate.hmr2300 import Hmr2300Encoder
from sitl.fluxgate.rm3100 import Rm3100Encoder
from sitl.fluxgate.twinleaf import TwinleafEncoder

__all__ = ["ENCODERS", "Encoder", "open_encoder"]

ENCODERS: dict[str, type[Encoder]] = {
    "ascii": AsciiEncoder,
    "digitizer": DigitizerEncoder,
    "hmr2300": Hmr2300Encoder,
    "rm3100": Rm3100Encoder,
    "twinleaf": TwinleafEncoder,
}
"""Driver's name: the emulated instrument."""


def open_encoder(
    name: str, options: Mapping[str, Any], rate: float = 1.0, source: str | Path = "bridge.toml"
) -> Encoder:
    """Return the emulated instrument that the driver called `name` reads.

    Arguments are those of :func:`magbridge.sensors.open_driver`; `rate` is that of the readings, Hz, for an
    instrument that gives a reading's number in place of its time.

    Raises
    ------
    ConfigError
        No such instrument, or a wrong option.
    """
    others = {} if name in ENCODERS else plugins("magbridge.encoders")
    if name not in ENCODERS and name not in others:
        raise ConfigError(source, "sensor.driver", f"can emulate {', '.join(sorted({*ENCODERS, *others}))}")
    encoder: type[Encoder] = ENCODERS[name] if name in ENCODERS else load(others[name])
    return encoder(convert(dict(options), encoder.Options, source, "sensor.options."), rate)
