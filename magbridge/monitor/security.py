"""Check every request and websocket, so that only authorised users see the page and set parameters.

A page on a loopback address is open to users of the computer, but also to any website in their browsers. A
website can send requests to ``localhost``, open a websocket to it (browsers allow this), or show the page in
a frame. Its name can also resolve to 127.0.0.1 (DNS rebinding). The headers ``Host`` and ``Origin`` identify
such requests. On any other address, the whole network can reach the page, so a token is required as well.
"""

from __future__ import annotations

from hmac import compare_digest
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
"""Headers of every response: the page loads nothing from other sites, and no site may frame it."""
NOT_STORED = {"Cache-Control": "no-store"}
LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}


def is_loopback(host: str) -> bool:
    """Return True if only this computer can reach a server at the address `host`."""
    return host == "localhost" or (_is_address(host) and ip_address(host).is_loopback)


class Guard:
    """ASGI middleware that rejects requests that do not come from the page itself.

    The page is served at `host` and `port`. A browser sends the `token` once, as ``?token=`` in the address;
    afterwards it sends a cookie. An empty `token` means that none is required. The guard rejects a request

    * with 421 if ``Host`` is not a name of this computer. On a network address, an IP address is also
      accepted, because a foreign name can resolve to this computer but an address cannot;
    * with 403 if ``Origin`` or ``Sec-Fetch-Site`` names another site, except if the user follows a link to
      the page;
    * with 401 if the token is missing or wrong.
    """

    def __init__(self, app: ASGIApp, host: str, port: int, token: str = "") -> None:
        self._app, self._port, self._token = app, port, token
        self._loopback = is_loopback(host)
        self._names = LOCAL_NAMES | {host}
        self._cookie = f"magbridge_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on to the page, or reject it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        refusal = self._refusal(asked)
        if refusal is None and self._token and not _same(asked.cookies.get(self._cookie, ""), self._token):
            if scope["type"] == "http" and _same(asked.query_params.get("token", ""), self._token):
                await self._admission(asked)(scope, receive, send)
                return
            refusal = 401, "a token is required: open the address that magbridge monitor printed"
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await receive()  # the "connect" event; closing before acceptance makes the response a 403
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
        else:
            status, reason = refusal
            answer = PlainTextResponse(f"magbridge: {reason}\n", status, HEADERS | NOT_STORED)
            await answer(scope, receive, send)

    def _refusal(self, asked: HTTPConnection) -> tuple[int, str] | None:
        """Return HTTP status and reason if a request comes from another site; None if from this page."""
        headers, host = asked.headers, asked.headers.get("host", "")
        if not self._is_this_page(host):
            return 421, "not a name of this page: use its address"
        if "origin" in headers and _parts(headers["origin"]) != _parts(f"//{host}"):
            return 403, "asked for by another site"
        site, mode = headers.get("sec-fetch-site", "none"), headers.get("sec-fetch-mode", "")
        link = mode == "navigate" and headers.get("sec-fetch-dest") == "document" and asked["path"] == "/"
        if site not in {"none", "same-origin"} and not (link and asked.get("method") == "GET"):
            return 403, "asked for by another site"
        return None

    def _is_this_page(self, host: str) -> bool:
        """Return True if a Host header has a name (and on a loopback address, the port) of this page."""
        parts = _parts(f"//{host}")
        if parts is None:
            return False
        name, port = parts
        if self._loopback and port not in {None, self._port}:
            return False
        return name in self._names or (not self._loopback and _is_address(name))

    def _admission(self, asked: HTTPConnection) -> Response:
        """Return a redirection to the address without the token, with a cookie that holds the token."""
        query = asked.url.remove_query_params("token").query
        place = "/" + asked["path"].lstrip("/") + (f"?{query}" if query else "")
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        return RedirectResponse(place, 303, HEADERS | NOT_STORED | {"Set-Cookie": cookie})


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            # omit the headers with which socket.io grants access to any site
            for name in [name for name in headers if name.startswith("access-control-")]:
                del headers[name]
            headers.update(HEADERS)
        await send(message)

    return sending


def _same(secret: str, expected: str) -> bool:
    """Compare two secrets in a time that is independent of where they differ."""
    return compare_digest(secret.encode("utf-8", "replace"), expected.encode("utf-8", "replace"))


def _parts(url: str) -> tuple[str, int | None] | None:
    """Return name and port of a URL, or None if the URL has no valid name or port."""
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
