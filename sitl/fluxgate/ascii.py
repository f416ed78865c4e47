"""A line protocol, as the configuration describes it."""

from __future__ import annotations

from math import inf

from magbridge.columns import NT_PER_UNIT
from magbridge.records import Reading
from magbridge.sensors import ascii as wire
from sitl.fluxgate.encoder import Encoder, clip


class AsciiEncoder(Encoder):
    """Sends a line with every reading."""

    Options = wire.AsciiOptions

    def encode(self, reading: Reading) -> bytes:
        """Return one line; the end of another before the first: a listener cannot tell half a line."""
        options = self.options
        end = b"\r\n" if options.terminator == "\n" else b"\r"
        before = b"" if self.sequence else end
        time = reading.device_time % options.time_modulo if options.time_modulo else reading.device_time
        values = {
            "time": time / wire.SECONDS[options.time_unit],
            "temperature": reading.temperature,
            "supply": reading.supply,
            "sequence": self.sequence % (options.sequence_modulo or inf),
            "power_cycle": self.power_cycle,
            "-": 0,
        }
        for axis, value in zip("xyz", reading.field, strict=True):
            scaled = clip(value, options.range or inf) / (options.scale * NT_PER_UNIT.get(options.unit, 1.0))
            values[axis] = round(scaled) if options.unit == "counts" else scaled
        self.sequence += 1
        cells = [f"{values[name]:.13g}" for name in options.columns if name != "*"]
        if options.keys:
            pairs = zip(options.keys, cells, strict=True)
            line = "{" + ", ".join(f'"{key}": {cell}' for key, cell in pairs) + "}"
        else:
            line = (options.separator or " ").join(cells)
        text: bytes = (options.prefix + line).encode(wire.ENCODING)
        if options.checksum:
            digits, function = wire.CHECKSUMS[options.checksum]
            text += f"*{function(text):0{digits}X}".encode()
        return before + text + end
