"""The live demonstration: a glider's bridge, on a pty and a socket, as its page receives it."""

from __future__ import annotations

import select
import time
from pathlib import Path

import pytest

from magbridge.bridge.links import open_link
from magbridge.mavlink import Codec
from magbridge.mavlink.enums import MAG_PORT_STATE
from magbridge.monitor.charts import read_background
from magbridge.monitor.link import ReceivedBridges

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
