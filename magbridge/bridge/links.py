"""The MAVLink link, by its URL: UDP, TCP, or a serial line."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from magbridge.bridge.address import parse
from magbridge.bridge.port import Port
from magbridge.bridge.serial_port import may_be_device, serial_line
from magbridge.bridge.tcp import TcpClient, TcpServer
from magbridge.bridge.udp import UdpPort
from magbridge.errors import ConfigError

__all__ = ["LINKS", "open_link"]

LINKS: dict[str, Callable[[str, tuple[str, int]], Port]] = {
    "udpin": partial(UdpPort, listen=True),
    "udpout": partial(UdpPort, listen=False),
    "tcp": TcpClient,
    "tcpin": TcpServer,
}
"""Link kinds by the first part of the URL, as in the MAVLink world; any other URL is a serial device."""


def open_link(url: str, baudrate: int, source: str = "bridge.toml", key: str = "link.url") -> Port:
    """Return the (unopened) port for a MAVLink URL.

    Raises
    ------
    ConfigError
        An unknown kind of link or of serial URL, no device's name, or an address that is not HOST:PORT; it
        names `source` and `key`.
    """
    kind, colon, address = url.partition(":")
    if kind not in LINKS:
        named = kind == "serial" or address.startswith("//")
        if not named and ((colon and kind.isalnum()) or not may_be_device(url)):
            known = ", ".join(LINKS)
            raise ConfigError(source, key, f"expected {known} or a serial device, got {url!r}")
        return serial_line(url.removeprefix("serial:"), baudrate, source, key)
    try:
        host, port = parse(address)
        if not port and kind in ("udpout", "tcp"):  # of one's own, 0 is any that is free
            raise ValueError(url)  # noqa: TRY301 - as `parse` does
    except ValueError as error:
        raise ConfigError(source, key, f"expected HOST:PORT or [IPV6]:PORT, got {url!r}") from error
    return LINKS[kind](url, (host, port))
