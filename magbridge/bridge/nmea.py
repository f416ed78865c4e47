"""The port on which the bridge sends NMEA 0183 sentences."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from magbridge.bridge import states
from magbridge.bridge.links import open_link
from magbridge.bridge.port import Port
from magbridge.config import Config
from magbridge.errors import PortError

__all__ = ["NmeaOutput", "nmea_port"]

NMEA_RETRY_US = 1_000_000
"""µs between two attempts to open the port."""


def nmea_port(config: Config) -> Port | None:
    """Return the (unopened) port of ``[heading] nmea``, None without one.

    ConfigError: it is neither ``udp:HOST:PORT`` nor a serial device.
    """
    name = config.heading.nmea
    if name is None:
        return None
    url = f"udpout:{name.removeprefix('udp:')}" if name.startswith("udp:") else f"serial:{name}"
    return open_link(url, config.heading.nmea_baudrate, str(config.path), "heading.nmea")


class NmeaOutput:
    """Sends sentences on a port, which it opens again when it is lost.

    Parameters
    ----------
    port : Port
    notify : callable
        Receives a state frame when the port cannot be opened or is lost, once for each reason.
    """

    def __init__(self, port: Port, notify: Callable[[bytes], None]) -> None:
        self._port, self._notify = port, notify
        self._reported = ""
        self._retry_us = 0

    def send(self, sentences: deque[bytes], time_us: int) -> None:
        """Send the sentences and empty the queue; those that come while the port is down are dropped."""
        if not sentences:
            return
        data = b"".join(sentences)
        sentences.clear()
        try:
            if not self._port.is_open:
                if time_us < self._retry_us:
                    return
                self._retry_us = time_us + NMEA_RETRY_US
                self._port.open()
                self._reported = ""
            self._port.write(data)
            self._port.flush()
        except PortError as error:
            if error.reason != self._reported:
                self._reported = error.reason
                self._notify(states.notice(f"heading.nmea: {error.reason}"[:50]))

    def close(self) -> None:
        """Close the port."""
        self._port.close()
