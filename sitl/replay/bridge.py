"""Run the bridge in a process of its own during a replay, with real ports and the timetable's clock.

:class:`sitl.replay.stage.Stage` starts this module; it is not a command for users.
"""

from __future__ import annotations

import argparse
import os
import select
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from magbridge.bridge.devices import SerialPort
from magbridge.bridge.events import Event, StartEvent, port_number
from magbridge.bridge.links import open_link
from magbridge.bridge.pipeline import drive, set_up
from magbridge.bridge.port import Port
from magbridge.config import Log, load
from magbridge.errors import MagbridgeError, WriteError
from magbridge.logs.tlog import TlogWriter
from magbridge.records import Channel
from sitl.replay.stage import read_entries

EVENTS_PER_BATCH = 8192
"""Number of bytes to the autopilot that are collected before they are sent."""


class ScriptedEdge:
    """Source of events that reads real ports in the order and with the times of a timetable."""

    def __init__(self, ports: dict[int, Port], timetable: int) -> None:
        self._ports = ports
        self._timetable = timetable
        self._entries = read_entries(self._wait_for_times)
        self._unread = {number: bytearray() for number in ports}
        self._unsent = bytearray()

    def start(self) -> StartEvent:
        """Return the start event, with which the timetable begins."""
        *_, data = next(self._entries)
        return msgspec.json.decode(data, type=StartEvent)

    def events(self, _deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield the events of the timetable, with the bytes read from the ports."""
        for time_us, channel, sensor_id, size, data in self._entries:
            if channel is not Channel.STATE:
                number = port_number(sensor_id) if channel is Channel.SENSOR else Channel.LINK
                data = self._read(number, size)  # noqa: PLW2901 - the timetable has the bytes of states only
            yield Event(time_us, channel, data, sensor_id)
        self.flush()

    def _wait_for_times(self) -> bytes:
        self.flush()  # in a paced replay, published messages must be seen before the next event
        return os.read(self._timetable, 65536)

    def _read(self, number: int, size: int) -> bytes:
        """Wait for exactly `size` bytes of the port `number`, and return them."""
        unread = self._unread[number]
        while len(unread) < size:
            port = self._ports[number]
            if select.select(port.fds(), [], [], 10.0)[0]:
                unread += port.read()
        data = bytes(unread[:size])
        del unread[:size]
        return data

    def send(self, number: int, data: bytes) -> None:
        """Send bytes to the autopilot; drop commands to a sensor, because the replay has its answers."""
        if number != Channel.LINK:
            return
        self._unsent += data
        if len(self._unsent) >= EVENTS_PER_BATCH:
            self.flush()

    def credit(self, frames: list[bytes]) -> None:
        """Do nothing: a replay has only one peer."""

    def flush(self) -> None:
        """Send all collected bytes to the autopilot."""
        self._ports[Channel.LINK].write_all(bytes(self._unsent))
        self._unsent.clear()


def main() -> int:
    """Run the bridge on the ports of the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path)
    parser.add_argument("--sensor", required=True, nargs="+")
    parser.add_argument("--link", required=True)
    parser.add_argument("--timetable", type=int, required=True)
    parser.add_argument("--log", type=Path)
    chosen = parser.parse_args()
    try:
        config = load(chosen.config)
        if chosen.log and config.log is None:
            config = msgspec.structs.replace(config, log=Log(directory=str(chosen.log)))
        ports: dict[int, Port] = {}
        for one, device in zip(config.sensors, chosen.sensor, strict=True):
            ports[port_number(one.id or 0)] = SerialPort(device, one.baudrate)
        ports[Channel.LINK] = open_link(chosen.link, 0)
        for port in ports.values():  # open the link last: the stage begins to send when the link connects
            port.open()
        edge = ScriptedEdge(ports, chosen.timetable)
        pipeline = set_up(config, edge.start())
        log = TlogWriter(chosen.log, header=pipeline.declarations) if chosen.log else None
        drive(pipeline, edge, log, lambda _: None)
        if log is not None:
            log.close(timeout=60.0)
            if log.failure:
                raise WriteError(chosen.log, log.failure)
    except MagbridgeError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
