"""Create the pipeline of a configuration and feed it with events, live or in a replay."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from magbridge.bridge.events import Event, StartEvent, port_number
from magbridge.bridge.learning import first_calibration
from magbridge.bridge.pipeline import Pipeline
from magbridge.bridge.sensor import other_calibrations
from magbridge.config import Config
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import load_key
from magbridge.records import Channel

__all__ = ["Edge", "drive", "set_up"]


class Edge(Protocol):
    """Source of events and destination of bytes."""

    def events(self, deadline: Callable[[], int]) -> Iterator[Event]:
        """Yield events in order; at least an empty one by `deadline` (µs)."""
        ...

    def send(self, number: int, data: bytes) -> None:
        """Send to the link or to a sensor, by its MAG_PORT_NAME."""
        ...

    def credit(self, frames: list[bytes]) -> None:
        """Record which frames of the last event from the link were signed with the key."""
        ...


def set_up(config: Config, start: StartEvent) -> Pipeline:
    """Return the pipeline that a configuration describes.

    ConfigError, FormatError, CalibrationError: the content of the configuration, or of a file that it names,
    is wrong.
    """
    calibration = first_calibration(config)
    key = load_key(config.resolve(config.link.signing_key)) if config.link.signing_key else None
    navigate = None
    if config.navigation is not None:
        from magbridge.bridge.navigation import open_navigation  # noqa: PLC0415 - it brings filterpy

        navigate = open_navigation(config, config.navigation, calibration)
    return Pipeline(config, calibration, start, key, navigate, other_calibrations(config))


def drive(pipeline: Pipeline, edge: Edge, log: TlogWriter | None, after_event: Callable[[int], None]) -> None:
    """Feed the pipeline until the edge ends; call ``after_event(time_us)`` after each event."""
    for event in edge.events(lambda: pipeline.deadline):
        sent = pipeline.feed(event)
        if pipeline.component.genuine:
            edge.credit(pipeline.component.genuine)
        if sent:
            edge.send(Channel.LINK, b"".join([frame for _, frame in sent]))
        for stream in pipeline.streams:
            if commands := stream.line.to_send:
                edge.send(port_number(stream.sensor_id), b"".join(commands))
                commands.clear()
        records = pipeline.recorder.drain()
        if log is not None and records:
            log.extend(records)
        after_event(event.time_us)
