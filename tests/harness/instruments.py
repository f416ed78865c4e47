"""Connect each driver to its emulated instrument; one TIO device has the protocol of the first generation."""

from typing import Any

from magbridge.sensors import Driver, open_driver, tio
from sitl.fluxgate import FLOAT32, Encoder, TwinleafEncoder, open_encoder


class OldTwinleafEncoder(TwinleafEncoder):
    """Emulated TIO device whose stream 0 has the field, and which describes its samples on request."""

    stream = 0

    def _header(self, number: int) -> bytes:
        return (number % tio.WRAP_1).to_bytes(4, "little")

    def _answer(self, method: bytes, reply: bytes) -> bytes:
        return self._describe() + self._slip(tio.RPC_REPLY, reply) if method == b"data.send_all" else b""

    def _describe(self) -> bytes:
        numerator, denominator = self._rate.denominator * 1_000_000, self._rate.numerator
        name = self._columns[0].partition(".")[0]
        axes = ",".join(column.rpartition(".")[2] for column in self._columns[:3])
        sources = [(f"{name}\t{axes}\t{name}\t{self._unit}", 3)]
        sources += [(f"{column}\t\t{column}\tC", 1) for column in self._columns[3:]]
        packets = self._slip(tio.TIMEBASE, tio.TIMEBASE_HEADER.pack(0, numerator, denominator) + bytes(16))
        components = b""
        for number, (text, channels) in enumerate(sources):
            header = tio.SOURCE_HEADER.pack(number, channels, FLOAT32)
            packets += self._slip(tio.SOURCE, header + text.encode())
            components += tio.COMPONENT.pack(number)
        return packets + self._slip(tio.STREAM, tio.STREAM_HEADER.pack(0, 0, 1, len(sources)) + components)


def open_old_twinleaf(options: dict[str, Any], rate: float) -> TwinleafEncoder:
    """Return the emulated device, with the options of the driver ``twinleaf``."""
    return OldTwinleafEncoder(open_encoder("twinleaf", options).options, rate)


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
