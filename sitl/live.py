"""Run the demonstration's glider in real time, with its bridge on a pty and a socket, for the monitor page.

::

    fluxgate --pty--> magbridge run <--UDP--> router <--UDP--> page
                                               ^
                                autopilot -----'
"""

from __future__ import annotations

import os
import pty
import select
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Event as Stop
from threading import Thread

import msgspec
import xarray as xr

from magbridge.calibration.file import save
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import unfiltered
from magbridge.calibration.fitting.observe import observations
from magbridge.config import load as load_config
from magbridge.logs import write
from magbridge.records import Channel
from sitl.dataset import segments
from sitl.replay.emulation import emulate
from sitl.replay.setup import bridge_toml
from sitl.scenario import load
from sitl.twin import Twin, simulate

__all__ = ["MAP", "flying"]

MAP = "grid.nc"
"""File name of the anomaly map of the glider's world."""

PARAMETERS = ("battpos", "ballast")
RATE = 1.0
"""Rate of the fluxgate, Hz; the scenario's 0.25 Hz is too slow to watch."""
LEAD = 8.0
"""Time until the first sample, s, in which the bridge starts."""
ENDING = 10.0
"""Longest time for the bridge to end, s."""


@contextmanager
def flying(folder: Path, seed: int = 1, notify: Callable[[str], None] = print) -> Iterator[str]:
    """Run the simulated glider while the context lasts; yield the URL for a ground station's link.

    The function writes the deployment, calibration, anomaly map, bridge configuration and log to `folder`.
    It calls `notify` with a line about each step.
    """
    notify("simulating a glider and fitting its calibration to the spirals")
    survey = _prepare(folder, seed)
    stop = Stop()
    with ExitStack() as opened:
        master, slave = pty.openpty()
        opened.callback(os.close, master)
        opened.callback(os.close, slave)
        tty.setraw(slave)
        os.set_blocking(master, False)
        router = _Router(opened)
        text = bridge_toml(survey, PARAMETERS, calibrated=True, log="logs")
        text = text.replace("/dev/null", os.ttyname(slave)).replace("14550", str(router.bridge_port))
        config = folder / "bridge.toml"
        config.write_text(text, encoding="utf-8")
        notify("starting the bridge")
        command = [sys.executable, "-m", "magbridge", "run", "--config", str(config)]
        bridge = subprocess.Popen(  # noqa: S603 - our own
            command, stderr=subprocess.DEVNULL, start_new_session=True
        )
        opened.callback(_end, bridge)
        survey = _state_at(survey, time.time() + LEAD)
        for thread in (
            Thread(target=router.run, args=(stop,), daemon=True),
            Thread(target=_play, args=(survey, config, master, router, stop), daemon=True),
        ):
            thread.start()
            opened.callback(thread.join, timeout=2.0)
        opened.callback(stop.set)
        yield f"udpout:127.0.0.1:{router.station_port}"


def _prepare(folder: Path, seed: int) -> xr.Dataset:
    """Simulate a deployment, fit and save its calibration, and return the survey."""
    scenario = load("demo")
    instrument = msgspec.structs.replace(scenario.instrument, rate=RATE)
    scenario = msgspec.structs.replace(scenario, instrument=instrument)
    deployment = simulate(scenario, seed)
    Twin.draw(scenario, seed).anomaly_map().save(folder / MAP)
    write(deployment, folder / "deployment.nc")
    parts = segments(deployment)
    training = unfiltered(observations(parts["calibration"], PARAMETERS), scenario.instrument.corner)
    save(fit(training, "auto").calibration, folder / "cal.json")
    return parts["survey"]


def _state_at(survey: xr.Dataset, begin: float) -> xr.Dataset:
    """Return the survey with its times shifted to begin at `begin`, s since 1970."""
    shift = begin - float(survey["time"][0])
    moved = {
        name: survey[name] + shift for name in map(str, survey.data_vars) if name.startswith("mag_time_")
    }
    return survey.assign(moved).assign_coords(time=survey["time"] + shift)


def _play(survey: xr.Dataset, config: Path, master: int, router: _Router, stop: Stop) -> None:
    """Send the bytes of the emulated fluxgate and autopilot at their times, until `stop` is set."""
    for event in emulate(survey, load_config(config)):
        if stop.wait(max(0.0, event.time_us * 1e-6 - time.time())):
            return
        with suppress(OSError):  # unread bytes are lost, as on a wire
            if event.channel is Channel.SENSOR:
                os.write(master, event.data)
            elif event.channel is Channel.LINK:
                router.send(0, event.data)
                router.send(1, event.data)
            os.read(master, 4096)  # commands to the fluxgate


def _end(bridge: subprocess.Popen[bytes]) -> None:
    bridge.terminate()
    try:
        bridge.wait(ENDING)
    except subprocess.TimeoutExpired:
        bridge.kill()
        bridge.wait()


class _Router:
    """Router of UDP datagrams between bridge and ground station; both receive the autopilot's."""

    def __init__(self, opened: ExitStack) -> None:
        self._sockets = [
            opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        ]
        for one in self._sockets:
            one.bind(("127.0.0.1", 0))
            one.setblocking(False)
        self._peers: list[tuple[str, int] | None] = [None, None]
        self.bridge_port, self.station_port = (one.getsockname()[1] for one in self._sockets)

    def run(self, stop: Stop) -> None:
        """Forward received datagrams until `stop` is set."""
        while not stop.is_set():
            ready, _, _ = select.select(self._sockets, [], [], 0.2)
            for one in ready:
                side = self._sockets.index(one)
                with suppress(OSError):
                    data, self._peers[side] = one.recvfrom(65536)
                    self.send(1 - side, data)

    def send(self, side: int, data: bytes) -> None:
        """Send bytes to the bridge (side 0) or to the ground station (1), if its address is known."""
        peer = self._peers[side]
        if peer is not None:
            self._sockets[side].sendto(data, peer)
