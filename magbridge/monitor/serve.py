"""Start the web server of the page."""

from __future__ import annotations

import secrets
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
from magbridge.monitor.security import Guard, is_loopback


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
    """Receive bridges on `link`, and serve the page at `host` and `port` until interrupted.

    If other computers can reach `host`, a token is required; the printed address contains it. With a `key` of
    32 bytes, messages are signed and frames without a valid signature rejected. The map shows the anomaly
    `grid` beneath the track. With `show`, the page opens in the browser of this computer.

    ConfigError: `link` is not an address. PortError: `link` or the port of the page cannot be opened.
    FormatError: `grid` is not a grid.
    """
    background = read_background(grid) if grid else None
    station = StationLink(open_link(link, baudrate, "magbridge monitor", "LINK"), key)
    ipv6 = ":" in host
    family, place = (socket.AF_INET6, f"[{host}]:{port}") if ipv6 else (socket.AF_INET, f"{host}:{port}")
    try:
        # fail here, because the web server would only log the error
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        raise PortError(place, error.strerror or str(error)) from error
    station.start()
    token = "" if is_loopback(host) else secrets.token_urlsafe(16)  # 128 random bits
    address = f"http://{place}" + (f"/?token={token}" if token else "")
    print(f"listening on {link}; the page is {address}", file=sys.stderr)
    if token:
        warning = "the page is open to the network, unencrypted: everyone with its address can set parameters"
        print(f"warning: {warning}", file=sys.stderr)
    app.add_middleware(Guard, host=host, port=port, token=token)
    options: dict[str, Any] = {"title": "magbridge", "favicon": "🧲", "show_welcome_message": False}
    with suppress(KeyboardInterrupt):  # Ctrl-C ends the server
        page = partial(Page, station, background)
        ui.run(page, host=host, port=port, show=show, reload=False, dark=None, **options)
