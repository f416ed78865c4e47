"""Test the page of the real command in a browser, with real datagrams."""

import re
import select
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import Command
from devices import udp_socket
from station import get, served

from magbridge.bridge.links import open_link
from magbridge.mavlink import Codec, Signing
from magbridge.mavlink.enums import MAG_PORT_STATE
from magbridge.monitor.charts import read_background
from magbridge.monitor.link import ReceivedBridges

pytest.importorskip("nicegui")


def test_page() -> None:
    bridge = Codec(1, 191)
    with served() as (url, link), udp_socket(10.0) as sender:
        assert "nothing heard yet" in get(url)
        field = {"total_field": 52_134.268, "total_field_sigma": 0.6, "time_usec": 10**15, "flags": 4}
        field |= {"magnetic_heading": 20.0, "heading": 3.25, "heading_sigma": 0.75}
        sender.sendto(bridge.pack("MAG_FIELD", **field), link)
        received_at = Codec(1, 191).parse(sender.recv(4096))
        assert received_at[0].name in {"HEARTBEAT", "PARAM_REQUEST_LIST"}
        assert (received_at[0].system, received_at[0].component) == (255, 190)
        for name, fields in (
            ("MAG_STATUS", {"sensor_state": 3, "uptime": 9}),
            ("MAG_NAVIGATION", {"state": 2, "lat": 495_000_000, "lon": -579_000_000}),
            ("STATUSTEXT", {"severity": 3, "text": "sensor lost: unplugged"}),
            ("PARAM_VALUE", {"param_id": "MB_SETTLE_TIME", "param_value": 5.0, "param_count": 3}),
            ("PARAM_VALUE", {"param_id": "MB_AGE_FIN", "param_value": 30.0, "param_count": 3}),
            ("PARAM_VALUE", {"param_id": "MB_R_FIELD", "param_value": 0.0, "param_count": 3}),
        ):
            sender.sendto(bridge.pack(name, **fields), link)
        shown = (
            "52\u202f134.27",
            "± 1.20",
            "003.2\N{DEGREE SIGN} true ± 1.5\N{DEGREE SIGN}",
            "live, flagged",
            "A mass is moving",
            "49.50000, -57.90000",
            "tracking",
            "MB_SETTLE_TIME",
            "older telemetry is stale; 0.01 to 1e+06 s",
            "rate of MAG_FIELD; 0 with every sample, -1 off; -1 to 1000 Hz",
            "sensor lost: unplugged",
            "vehicle 1, component 191",
        )
        html = until_shown(url, *shown, again=lambda: sender.sendto(bridge.pack("MAG_FIELD", **field), link))
    assert 'content="normal"' in html  # light or dark, as the browser asks
    assert 'src="http' not in html  # it must show without a network
    assert 'href="http' not in html


def until_shown(url: str, *texts: str, again: Callable[[], object] = bool) -> str:
    """Request a page, and do something `again`, until the page has all texts; return the page."""
    deadline = time.monotonic() + 15.0
    while missing := [text for text in texts if text not in (html := get(url))]:
        assert time.monotonic() < deadline, missing
        again()
    return html


def test_a_clock_set_back_hides_no_silence(tmp_path: Path) -> None:
    (clock := tmp_path / "offset").write_text("0")
    with served(clock=clock) as (url, link), udp_socket(10.0) as sender:
        sender.sendto(Codec(1, 191).pack("MAG_FIELD", total_field=52_134.268), link)
        sender.recv(4096)
        clock.write_text("-3600000000")
        received_at = b"".join([sender.recv(4096) for _ in range(10)])
        names = [message.name for message in Codec(1, 191).parse(received_at)]
        assert names.count("HEARTBEAT") > 1
        until_shown(url, "nothing heard for")


def test_a_bridge_that_signs_is_asked_in_signed_messages(tmp_path: Path) -> None:
    """Only messages that are signed with the same key are accepted."""
    key = bytes(range(32))
    (tmp_path / "key").write_bytes(key)
    bridge = Codec(1, 191, Signing(key))
    with served("--signing-key", str(tmp_path / "key")) as (url, link), udp_socket(10.0) as sender:
        sender.sendto(Codec(1, 191).pack("MAG_FIELD", total_field=52_134.268), link)
        until_shown(url, "nothing heard yet; frames refused for their signature: 1")
        bridge.now_us = time.time_ns() // 1000
        sender.sendto(bridge.pack("MAG_FIELD", total_field=52_134.268), link)
        names = [bridge.parse(sender.recv(4096))[0].name for _ in range(3)]
    assert "PARAM_REQUEST_LIST" in names


def test_bad_input_is_one_line(command: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        with socket.create_server(("127.0.0.1", 0)) as closed:
            free = str(closed.getsockname()[1])
        for arguments, code, expected in (
            (["udpin:nowhere"], 2, "magbridge monitor: LINK: expected HOST:PORT or [IPV6]:PORT"),
            (["/dev/nowhere", "--port", free], 1, "/dev/nowhere: "),
            (["udpin:127.0.0.1:0", "--port", port], 1, f"127.0.0.1:{port}: Address already in use"),
            (["--port", "99999"], 2, "99999"),
            (["--signing-key", "/nowhere", "--port", free], 1, "/nowhere: expected a file, there is none"),
        ):
            assert expected in command.refuses("monitor", *arguments, code=code)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)
    monkeypatch.delitem(sys.modules, "magbridge.monitor.serve", raising=False)
    line = command.refuses("monitor", code=2)
    # as installed: no public package is found by its name
    assert re.fullmatch(r"nicegui is not installed: pip install '/.+\[monitor\]'", line)


# ---- the live demonstration --------------------------------------------------------------------------------


live = pytest.importorskip("sitl.live", reason="the analysis extra is not installed")


def test_a_glider_is_flown_into_the_page(tmp_path: Path) -> None:
    """Corrected field, masses and track arrive, and the parameters can be read."""
    texts: list[str] = []
    with live.flying(tmp_path, 1, texts.append) as link:
        port, fleet, codec = open_link(link, 0, "test", "LINK"), ReceivedBridges(), Codec(255, 190)
        port.open()
        deadline = time.monotonic() + 60.0
        while not (state := fleet.states.get((1, 191))) or len(state.samples) < 3 or not state.parameters:
            assert time.monotonic() < deadline, texts
            ready, _, _ = select.select(port.fds(), [], [], 0.1)
            for message in codec.parse(port.read()) if ready else []:
                fleet.receive(message, time.monotonic())
            for name, fields in fleet.due(time.monotonic()):
                port.write(codec.pack(name, **fields))
            port.flush()
        port.close()
    assert {"battpos", "ballast"} <= set(state.telemetry)
    west, south, east, north = read_background(tmp_path / live.MAP).box  # beneath the track
    assert west < state.reported_track.latest.longitude < east
    assert south < state.reported_track.latest.latitude < north
    assert not list(state.alarms)  # starting is nothing to look at
    assert state.reported_track.latest.latitude == pytest.approx(49.52, abs=0.1)
    assert state.status["sensor_state"] == MAG_PORT_STATE.OK
    assert state.samples[-1]["total_field"] == pytest.approx(52_200, abs=500)
    assert abs(state.samples[-1]["time_usec"] * 1e-6 - time.time()) < 30.0
    assert state.samples[-1]["calibration_id"] != 0
