"""Driver ``twinleaf``: vector magnetometers that send either generation of Twinleaf I/O (:mod:`.tio`)."""

from __future__ import annotations

from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from magbridge.columns import NT_PER_UNIT
from magbridge.records import MAX_MEASURED_NT, Reading
from magbridge.sensors.framing import FramedDriver, saturated
from magbridge.sensors.tio import END, MAX_FRAME_BYTES, STREAM_TYPE, WRAP_1, Device, requests, unpack

__all__ = ["Twinleaf", "TwinleafOptions"]

MAX_ROUTING = 8


class TwinleafOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[sensor.options]`` of a TIO device."""

    columns: tuple[str, str, str] = ("vector.x", "vector.y", "vector.z")
    """The device's names of the three channels."""
    temperature: str = ""
    """The device's name of the column with the temperature in degC; empty for none."""
    unit: str | None = None
    """Unit of the channels, in place of the unit that the device states."""
    route: Annotated[str, Meta(pattern=r"^/?(\d+(/\d+)*/?)?$")] = "/"
    """Port numbers from the root to the device in a tree of devices, such as ``/0/2``."""
    range: Annotated[float, Meta(gt=0)] = 100_000.0
    """Field at which a channel saturates, nT."""

    def __post_init__(self) -> None:
        if self.unit is not None and self.unit not in NT_PER_UNIT:
            raise ValueError(f"unit: expected one of {' '.join(NT_PER_UNIT)}")
        hops = self.hops()
        if len(hops) > MAX_ROUTING or max(hops, default=0) > 255:
            raise ValueError(f"route: expected at most {MAX_ROUTING} numbers up to 255")

    def hops(self) -> list[int]:
        """Return the port numbers from the root of the device tree to the device."""
        return [int(hop) for hop in self.route.split("/") if hop]


class Twinleaf(FramedDriver):
    """Parser of the packets of a TIO device of either generation.

    ``Reading.power_cycle`` is the session number of the device; ``Reading.sequence`` counts all samples.
    """

    Options: ClassVar = TwinleafOptions
    sequence_modulo = WRAP_1

    def __init__(self, options: TwinleafOptions) -> None:
        super().__init__(END, MAX_FRAME_BYTES)
        self.range_nt, self._routing = options.range, bytes(reversed(options.hops()))
        self._device = Device(options.columns, options.temperature, options.unit)

    def start(self) -> tuple[bytes, ...]:
        """Return one command: a heartbeat, and each generation's request for descriptors."""
        return (requests(self._routing),)

    def read_frame(self, frame: bytes) -> list[Reading]:
        """Return the readings in a packet; ValueError, IndexError, struct.error: the packet is invalid."""
        kind, payload, routing = unpack(frame)
        stream = kind - STREAM_TYPE
        if routing != self._routing:
            return []
        if stream < 0:
            self._device.receive(kind, payload)
            return []
        samples = self._device.samples(stream, payload)
        if samples is None:
            self._framer.skipped += len(payload)
        readings = []
        for number, time, (x, y, z, temperature) in samples or ():
            is_field = abs(x) + abs(y) + abs(z) < MAX_MEASURED_NT  # False for NaN
            if not is_field or abs(temperature) > MAX_MEASURED_NT:
                self.frames_bad += 1
                continue
            reading = Reading(
                (x, y, z), None, number % WRAP_1, time, temperature=temperature,
                power_cycle=self._device.session, saturated=saturated(x, y, z, self.range_nt),
            )  # fmt: skip
            readings.append(reading)
        return readings
