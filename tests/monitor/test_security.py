"""Test the access control with real requests and websockets, as a browser of another site sends them."""

import base64
import http.client
import os
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from station import served

pytest.importorskip("nicegui")

SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


def status(url: str, path: str = "/", method: str = "GET", **headers: str) -> http.client.HTTPResponse:
    """Return the status of a reply; names of `headers` have _ for -, and replace the usual headers."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer


def websocket(url: str, *, host: str = "", **headers: str) -> int:
    """Request a websocket; return the status of the reply, 101 if it is accepted."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), timeout=20) as connection:
        lines = [
            f"GET {SOCKET} HTTP/1.1",
            f"Host: {host or parts.netloc}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items()),
        ]
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(connection.recv(4096).split()[1])


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with served() as (address, _):
        yield address


def test_another_name_for_this_computer_is_refused(url: str) -> None:
    """DNS rebinding: their name, which resolves to us."""
    port = urlsplit(url).port
    theirs = "evil.example", f"evil.example:{port}", f"localhost.evil.example:{port}"
    for host in (*theirs, "127.0.0.1:1", "", "["):
        assert status(url, Host=host).status in {400, 421}, host
        if host:
            assert websocket(url, host=host) in {400, 403}, host
    for host in (f"localhost:{port}", f"127.0.0.1:{port}", f"[::1]:{port}"):
        assert status(url, Host=host).status == 200, host


def test_another_site_gets_neither_a_websocket_nor_an_answer(url: str) -> None:
    own = url.rstrip("/")
    polling = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    near = own.replace("http:", "https:") + "0"
    for origin in ("https://evil.example", "null", "http://127.0.0.1:1", near):
        assert websocket(url, Origin=origin) == 403, origin
        assert status(url, polling, Origin=origin).status == 403, origin
        assert status(url, "/", "POST", Origin=origin).status == 403, origin
    assert websocket(url, Origin=own) == 101
    assert websocket(url, Origin=own, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="websocket") == 403


def test_a_link_may_lead_here_but_no_other_page_frames_or_loads_it(url: str) -> None:
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}
    answer = status(url, Sec_Fetch_Dest="document", **link)
    assert answer.status == 200
    assert answer.headers["X-Frame-Options"] == "DENY"
    assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert status(url, Sec_Fetch_Dest="iframe", **link).status == 403
    assert status(url, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors").status == 403
    assert "Access-Control-Allow-Origin" not in answer.headers


def test_served_to_others_a_token_is_required() -> None:
    with served("--host", "0.0.0.0", warned=True) as (url, _):
        base, token = url.split("?token=")
        assert len(token) >= 20
        for path in ("/", "/?token=", "/?token=guess", f"/?token={token}x", SOCKET):
            assert status(base, path).status == 401, path
        assert websocket(base) == 403
        answer = status(base, f"/?token={token}")
        assert (answer.status, answer.headers["Location"]) == (303, "/")
        cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        known = {"Cookie": cookie.partition(";")[0]}
        assert status(base, **known).status == 200
        assert websocket(base, **known) == 101
        assert websocket(base, **known, Origin="http://evil.example") == 403
        assert status(base, Host="evil.example", **known).status == 421
        assert status(base, Cookie='a="; =;;;').status == 401
