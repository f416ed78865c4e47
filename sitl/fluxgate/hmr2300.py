"""The HMR2300: as delivered it sends ASCII, and only when asked."""

from __future__ import annotations

from magbridge.records import Reading
from magbridge.sensors import hmr2300 as wire
from magbridge.sensors.framing import Framer
from sitl.fluxgate.encoder import Encoder, clip

STOP = b"\x1b"


class Hmr2300Encoder(Encoder):
    """Three magnetoresistive channels, commands, two outputs."""

    Options = wire.Hmr2300Options

    def power_on(self) -> None:
        """Wait for commands."""
        super().power_on()
        self.streaming = self.binary = self._enabled = False
        self._latest = (0, 0, 0)
        self._lines = Framer(b"\r", 64)

    def encode(self, reading: Reading) -> bytes:
        """Return one frame or line, where it streams."""
        x, y, z = (round(clip(value / wire.NT_PER_COUNT, wire.MAX_COUNTS)) for value in reading.field)
        self._latest = x, y, z
        return self._sample() if self.streaming else b""

    def _sample(self) -> bytes:
        if self.binary:
            return wire.COUNTS_LAYOUT.pack(*self._latest) + b"\r"
        return ("  ".join(map(_comma, self._latest)) + "  \r").encode()

    def feed(self, data: bytes) -> bytes:
        """Obey commands and answer them."""
        if STOP in data:
            self.streaming = False
            data = data.replace(STOP, b"")
        return b"".join(self._obey(line.decode("latin-1").upper()) for line in self._lines.split(data))

    def _obey(self, line: str) -> bytes:
        own, command = f"*{self.options.device:02d}", line[3:]
        if line[:3] not in (own, "*99"):
            return b"Re-enter\r"
        if command == "C":
            self.streaming = True
            return b""
        if command == "P":
            return self._sample()
        return self._set(command)

    def _set(self, command: str) -> bytes:
        """Obey a command that is accepted only after a write enable."""
        enabled, self._enabled = self._enabled, command == "WE"
        if command in ("A", "B") and enabled:
            self.binary = command == "B"
            return b"BINARY ON\r" if self.binary else b"ASCII ON\r"
        if command == "WE" or (command.startswith("R=") and enabled):
            return b"OK\r"
        known = command in ("A", "B") or command.startswith("R=")
        return b"WE_OFF\r" if known else b"Re-enter\r"


def _comma(count: int) -> str:
    """Write a count as the instrument does: sign, two digits, comma, three digits, leading zeros blank."""
    return ("-" if count < 0 else " ") + f"{abs(count):,}".rjust(6)
