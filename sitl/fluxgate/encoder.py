"""What every emulated instrument offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from magbridge.records import Reading


class Encoder(ABC):
    """An instrument, switched on, with the options of the driver that reads it.

    `rate` is that of the readings, Hz, for an instrument that gives a reading's number in place of its time.
    It is `streaming` while it sends readings; some wait for a command. `power_cycle` is how many times it was
    switched on.
    """

    Options: ClassVar[Any]
    streaming = True

    def __init__(self, options: Any, rate: float = 1.0) -> None:
        self.options = options
        self.rate = rate
        self.power_cycle = 0
        self.power_on()

    def power_on(self) -> None:
        """Switch off and on again: add a power cycle, and count readings from 0."""
        self.power_cycle += 1
        self.sequence = 0

    @abstractmethod
    def encode(self, reading: Reading) -> bytes:
        """Return the bytes sent for one reading; none while it is not streaming.

        It uses the reading's field (nT, finite), `device_time` (s on its own clock, which begins at
        power-on), `channel_delay`, `temperature` and `supply`, where the instrument sends them; counters
        are its own.
        """

    def feed(self, data: bytes) -> bytes:  # noqa: ARG002 - most do not listen
        """Receive bytes that were sent to the instrument; return its answers."""
        return b""


def clip(value: float, limit: float) -> float:
    """Return `value`, at most `limit` either side of zero."""
    return max(-limit, min(value, limit))
