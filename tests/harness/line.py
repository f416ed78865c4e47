"""Connect the bridge's MAVLink component to a ground station by encoded frames, without ports."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

from magbridge.config import Align, Link, Telemetry
from magbridge.link.component import Component
from magbridge.link.parameters import alignment, telemetry_ages
from magbridge.mavlink import Codec

START = 1_700_000_000_000_000
SECOND = 1_000_000


class Line:
    """Link between the component, and pymavlink as ground station (255:190) or autopilot (1:1)."""

    def __init__(self, peer: ModuleType, **options: Any) -> None:
        self.peer = peer
        self.component = Component(
            Link("udpout:h:1"),
            options.pop("publish", {"MAG_FIELD": 0.0}),
            [*alignment(Align()), *telemetry_ages({"battpos": Telemetry("ATTITUDE", "roll")})],
            start_us=START,
            version="1.2.3",
            **options,
        )
        self.now = START
        self.station = peer.MAVLink(None, 255, 190)
        self.autopilot = Codec(1, 1)
        self.sent: list[tuple[int, bytes]] = []
        self.asked = 0  # number of the last command sent

    @staticmethod
    def only(messages: list[Any], name: str) -> list[Any]:
        return [message for message in messages if message.get_type() == name]

    def to(self, seconds: float) -> list[Any]:
        """Advance the time to `seconds` after the start; return the messages that the station receives."""
        self.now = START + round(seconds * SECOND)
        self.component.output.advance(self.now)
        return self.receive()

    def receive(self) -> list[Any]:
        frames = self.component.output.drain()
        self.sent += frames
        received: list[Any] = []
        for _, frame in frames:
            received += self.station.parse_buffer(frame) or []
        assert self.station.total_receive_errors == 0
        return received

    def send_message(self, name: str, /, *args: Any, **fields: Any) -> list[Any]:
        """Send a message from the station; return the messages that the station receives."""
        message = getattr(self.peer, f"MAVLink_{name.lower()}_message")(*args, **fields)
        return self.give(message.pack(self.station))

    def fly(self, name: str, **fields: Any) -> list[Any]:
        """Send a message from the autopilot; return the messages that the station receives."""
        return self.give(self.autopilot.pack(name, **fields))

    def give(self, data: bytes) -> list[Any]:
        self.telemetry = self.component.receive(data, self.now)
        return self.receive()

    def texts(self, messages: list[Any]) -> list[str]:
        return [message.text for message in self.only(messages, "STATUSTEXT")]

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 191)) -> list[Any]:
        self.asked = number
        return self.send_message("command_long", *target, number, 0, *[*params, 0, 0, 0, 0, 0, 0, 0][:7])


MakeLine = Callable[..., Line]
"""Function ``make_link(**options)`` that returns a line whose component has these options."""
