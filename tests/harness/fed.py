"""Feed events to a bridge without ports, and read the messages that it sends."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from small import START

from magbridge.bridge.events import Event
from magbridge.bridge.pipeline import Pipeline
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Codec, Message
from magbridge.records import Channel


def received(frames: Iterable[tuple[int, bytes]]) -> list[Message]:
    """Return the messages in frames, each with its event time (µs)."""
    return Codec(255, 190).parse(b"".join([frame for _, frame in frames]))


def named(messages: Iterable[Message], name: str) -> list[Message]:
    """Return the messages called `name`."""
    return [message for message in messages if message.name == name]


def texts(messages: Iterable[Message]) -> list[str]:
    """Return the texts of the STATUSTEXTs."""
    return [message["text"] for message in named(messages, "STATUSTEXT")]


def fed(pipeline: Pipeline, *events: Event) -> list[Message]:
    """Feed events to a bridge; return the messages that it sends."""
    return received([frame for event in events for frame in pipeline.feed(event)])


def logged(
    pipeline: Pipeline, events: Iterable[Event], folder: Path, **options: Any
) -> list[tuple[int, bytes]]:
    """Feed events to a bridge that writes the log into a folder; return its frames with their times (µs)."""
    sent = []
    with closing(TlogWriter(folder, **{"header": pipeline.declarations, **options})) as log:
        for event in events:
            sent += pipeline.feed(event)
            log.extend(pipeline.recorder.drain())
    return sent


class FedBridge:
    """Bridge, and all messages that it has sent; times are seconds after its start."""

    def __init__(self, bridge: Pipeline) -> None:
        self.bridge, self.messages = bridge, list[Message]()

    def feed(self, seconds: float, channel: Channel, data: bytes, sensor_id: int = 0) -> list[Message]:
        """Feed one event; return the messages that the bridge sends."""
        event = Event(START + round(seconds * 1e6) // 4 * 4, channel, data, sensor_id)
        messages = fed(self.bridge, event)
        self.messages += messages
        return messages

    @property
    def texts(self) -> list[str]:
        """Texts of all STATUSTEXTs."""
        return texts(self.messages)
