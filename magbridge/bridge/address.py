"""Addresses of sockets: HOST:PORT or [IPV6]:PORT."""

from __future__ import annotations

import re
import socket
from ipaddress import IPv6Address
from operator import itemgetter
from typing import Any

__all__ = ["parse", "resolve"]

ADDRESS = re.compile(r"(?://)?(?:\[(?P<ipv6>.+)\]|(?P<host>[^:]*)):(?P<port>[0-9]{1,5})")


def parse(text: str) -> tuple[str, int]:
    """Return host and port; raises ValueError."""
    match = ADDRESS.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        raise ValueError(text)
    if match["ipv6"]:
        return str(IPv6Address(match["ipv6"])), int(match["port"])
    match["host"].encode("idna")  # raises UnicodeError, as looking it up would
    return match["host"], int(match["port"])


def resolve(address: tuple[str, int], kind: int, *, listen: bool) -> tuple[int, Any]:
    """Return the family and the socket address of a host; of a name that has both, IPv4's. Raises OSError."""
    host, port = address
    found = socket.getaddrinfo(host or None, port, type=kind, flags=socket.AI_PASSIVE if listen else 0)
    family, *_, resolved = min(found, key=itemgetter(0))
    return family, resolved
