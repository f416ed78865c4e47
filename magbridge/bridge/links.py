"""The MAVLink link, by its URL: UDP, TCP, or a serial line."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from magbridge.bridge.peers import Peers
from magbridge.bridge.port import Port
from magbridge.bridge.serial_port import may_be_device, serial_line
from magbridge.bridge.sockets import TcpClient, TcpServer, UdpPort, parse_address
from magbridge.errors import ConfigError

__all__ = ["LINKS", "open_link"]

CLIENT_LINKS: dict[str, Callable[[str, tuple[str, int]], Port]] = {"udpout": UdpPort, "tcp": TcpClient}
"""Kinds of link that go to one peer, by the first part of the URL, as in the MAVLink world."""
SHARED: dict[str, Callable[[str, tuple[str, int], Peers, bool], Port]] = {
    "udpin": lambda name, address, peers, _: UdpPort(name, address, peers),
    "tcpin": lambda name, address, peers, signed: TcpServer(name, address, peers, signed=signed),
}
"""Kinds of link that anyone can come to; any other URL is a serial device."""
LINKS = ("udpin", "udpout", "tcp", "tcpin")


def open_link(
    url: str,
    baudrate: int,
    source: str = "bridge.toml",
    key: str = "link.url",
    *,
    autopilot: tuple[int, int] | None = None,
    budget: float = inf,
    signed: bool = False,
) -> Port:
    """Return the (unopened) port for a MAVLink URL.

    Parameters
    ----------
    url : str
        As in ``[link]``.
    baudrate : int
        bit/s of a serial device.
    source, key : str
        What an error names.
    autopilot : (int, int) or None
        System and component that a link with many peers answers before all others.
    budget : float
        Bytes/s that all other peers get together there.
    signed : bool
        Peers are answered once :meth:`Port.credit` has named a frame of theirs.

    Raises
    ------
    ConfigError
        An unknown kind of link or of serial URL, no device's name, or an address that is not HOST:PORT.
    """
    kind, colon, address = url.partition(":")
    if kind not in LINKS:
        named = kind == "serial" or address.startswith("//")
        if not named and ((colon and kind.isalnum()) or not may_be_device(url)):
            known = ", ".join(LINKS)
            raise ConfigError(source, key, f"expected {known} or a serial device, got {url!r}")
        return serial_line(url.removeprefix("serial:"), baudrate, source, key)
    try:
        host, port = parse_address(address)
        if not port and kind in ("udpout", "tcp"):  # as a local port, 0 is any that is free
            raise ValueError(url)  # noqa: TRY301 - as `parse_address` does
    except ValueError as error:
        raise ConfigError(source, key, f"expected HOST:PORT or [IPV6]:PORT, got {url!r}") from error
    if kind in CLIENT_LINKS:
        return CLIENT_LINKS[kind](url, (host, port))
    return SHARED[kind](url, (host, port), Peers(autopilot, budget=budget, signed=signed), signed)
