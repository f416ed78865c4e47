"""The web server: where the page is, and who may come."""

from __future__ import annotations

import socket
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import app, ui

from magbridge.bridge.links import open_link
from magbridge.errors import PortError
from magbridge.monitor.charts import read_background
from magbridge.monitor.link import StationLink
from magbridge.monitor.page import Page
from magbridge.monitor.security import Guard, is_loopback, new_token


def serve(
    link: str,
    baudrate: int,
    host: str,
    port: int,
    *,
    key: bytes | None = None,
    grid: Path | None = None,
    show: bool = False,
) -> None:
    """Listen to `link` and serve the page at `host` and `port` until interrupted.

    Where `host` is not of this computer alone, a token is required; it is in the address that is printed.
    With a `key` of 32 bytes, messages are signed and unsigned frames refused. The anomaly `grid` is shown
    beneath the track.

    ConfigError, PortError: `link` is not an address, or it or the page's own port cannot be opened.
    FormatError: `grid` is none.
    """
    background = read_background(grid) if grid else None
    station = StationLink(open_link(link, baudrate, "magbridge monitor", "LINK"), key)
    ipv6 = ":" in host
    family, place = (socket.AF_INET6, f"[{host}]:{port}") if ipv6 else (socket.AF_INET, f"{host}:{port}")
    try:
        socket.create_server((host, port), family=family).close()  # the web server itself would only log it
    except OSError as error:
        raise PortError(place, error.strerror or str(error)) from error
    station.start()
    token = "" if is_loopback(host) else new_token()
    address = f"http://{place}" + (f"/?token={token}" if token else "")
    print(f"listening on {link}; the page is {address}", file=sys.stderr)
    if token:
        warning = "the page is open to the network, unencrypted: everyone with its address can set parameters"
        print(f"warning: {warning}", file=sys.stderr)
    app.add_middleware(Guard, host=host, port=port, token=token)
    options: dict[str, Any] = {"title": "magbridge", "favicon": "🧲", "show_welcome_message": False}
    with suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
        ui.run(
            partial(Page, station, background),
            host=host,
            port=port,
            show=show,
            reload=False,
            dark=None,
            **options,
        )
