"""Who may see the page, and set parameters from it: a guard before every request and every websocket.

A page on a loopback address is reached by users of the computer, but also by any website that they
have open: it can send requests to ``localhost``, open a websocket to it (which no browser forbids), show the
page in a frame, or have its own name resolve to 127.0.0.1 (DNS rebinding). The ``Host`` that a browser asks
for and the ``Origin`` of a request distinguishes these. On any other address, everybody in the network
comes that far, so there a token is required as well.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from hmac import compare_digest
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

POLICY = {
    "default-src": "'self'",
    "script-src": "'self' 'unsafe-inline' 'unsafe-eval'",  # Vue compiles its templates in the browser
    "style-src": "'self' 'unsafe-inline'",
    "img-src": "'self' data: blob:",
    "font-src": "'self' data:",
    "object-src": "'none'",
    "base-uri": "'none'",
    "form-action": "'self'",
    "frame-ancestors": "'none'",
}
HEADERS = {
    "Content-Security-Policy": "; ".join(f"{name} {sources}" for name, sources in POLICY.items()),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer: the page loads nothing from other sites, and no site may frame it."""
LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
MAX_COOKIE_CHARACTERS = 4096
"""Characters of a cookie header that are looked at."""


def is_loopback(host: str) -> bool:
    """Return True if an address to serve at is reached from this computer alone."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def new_token() -> str:
    """Return a token that cannot be guessed: 128 bits from the operating system, fit for an address."""
    return secrets.token_urlsafe(16)


class Guard:
    """ASGI middleware: refuses what does not come from the page itself.

    The page is served at `host` and `port`. A browser has to show the `token` once, as ``?token=`` in the
    address; then a cookie remembers it. Empty: no token is required. A request is refused

    * with 421 where ``Host`` is neither a name of this computer nor, where the page is served to others, an
      address: a name that somebody else owns may resolve to us, an address cannot;
    * with 403 where ``Origin`` is another site's, or the browser reports a request of another site
      (``Sec-Fetch-Site``), except for following a link to the page;
    * with 401 without the token.
    """

    def __init__(self, app: App, host: str, port: int, token: str = "") -> None:
        self._app, self._port, self._token = app, port, token
        self._loopback = is_loopback(host)
        self._names = LOCAL_NAMES | {host}
        self._cookie = f"magbridge_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]
        }
        refusal = self._refusal(scope, headers)
        if refusal is None and self._token and not self._known(headers):
            offered = dict(parse_qsl(scope.get("query_string", b"").decode("latin-1"))).get("token", "")
            if scope["type"] == "http" and _same(offered, self._token):
                await self._admit(scope, send)
                return
            refusal = 401, "a token is required: open the address that magbridge monitor printed"
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await receive()  # its "connect"; closed before it was accepted, the answer is a 403
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
        else:
            await _answer(send, refusal[0], f"magbridge: {refusal[1]}\n".encode())

    def _refusal(self, scope: Scope, headers: Mapping[str, str]) -> tuple[int, str] | None:
        """Return status and reason for a request that does not come from the page itself."""
        host = headers.get("host", "")
        if not self._is_this_page(host):
            return 421, "not a name of this page: use its address"
        if "origin" in headers and not _same_place(headers["origin"], host):
            return 403, "asked for by another site"
        site, mode = headers.get("sec-fetch-site", "none"), headers.get("sec-fetch-mode", "")
        link = mode == "navigate" and headers.get("sec-fetch-dest") == "document" and scope["path"] == "/"
        if site not in {"none", "same-origin"} and not (link and scope.get("method") == "GET"):
            return 403, "asked for by another site"
        return None

    def _is_this_page(self, host: str) -> bool:
        """Return True if a Host header names this page."""
        parts = _parts(f"//{host}")
        if parts is None:
            return False
        name, port = parts
        if self._loopback and port not in {None, self._port}:
            return False
        return name in self._names or (not self._loopback and _is_address(name))

    def _known(self, headers: Mapping[str, str]) -> bool:
        try:
            morsel = SimpleCookie(headers.get("cookie", "")[:MAX_COOKIE_CHARACTERS]).get(self._cookie)
        except CookieError:
            return False
        return morsel is not None and _same(morsel.value, self._token)

    async def _admit(self, scope: Scope, send: Send) -> None:
        """Remember the token in a cookie, and take it out of the address."""
        query = [pair for pair in parse_qsl(scope["query_string"].decode("latin-1")) if pair[0] != "token"]
        place = "/" + scope["path"].lstrip("/") + (f"?{urlencode(query)}" if query else "")
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        await _answer(send, 303, b"", Location=place, **{"Set-Cookie": cookie})


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
            # what socket.io allows to every site that asks is not given out
            given = [
                pair for pair in message["headers"] if not pair[0].lower().startswith(b"access-control-")
            ]
            message = {**message, "headers": [*given, *own]}
        await send(message)

    return sending


async def _answer(send: Send, status: int, text: bytes, **headers: str) -> None:
    headers = {"Content-Type": "text/plain; charset=utf-8", "Cache-Control": "no-store", **HEADERS, **headers}
    pairs = [(name.encode("latin-1"), value.encode("latin-1", "replace")) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": status, "headers": pairs})
    await send({"type": "http.response.body", "body": text})


def _same(secret: str, expected: str) -> bool:
    """Compare two secrets in a time that is independent of where they differ."""
    return compare_digest(secret.encode("utf-8", "replace"), expected.encode("utf-8", "replace"))


def _same_place(origin: str, host: str) -> bool:
    there, here = _parts(origin), _parts(f"//{host}")
    return there is not None and there == here


def _parts(url: str) -> tuple[str, int | None] | None:
    """Return name and port of an address; None where it has none."""
    try:
        parts = urlsplit(url)
        return ((parts.hostname or "").rstrip("."), parts.port) if parts.hostname else None
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
