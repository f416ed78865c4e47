"""Feed hand-made autopilot messages to the bridge's navigation, and collect its messages."""

from typing import Any

from passages import OPTIONS, PLACE, hills

from magbridge.bridge.navigation import NavigationService
from magbridge.config import Link
from magbridge.link.component import Component
from magbridge.link.estimates import FIX_MESSAGES
from magbridge.mavlink import Codec, Message
from magbridge.navigate import NavigationOptions
from magbridge.navigate.record import Reckoned

START_US = 1_780_000_000_000_000
ARDUPILOT, PX4 = 3, 12
ACK = {"command": 43003, "target_system": 1, "target_component": 191}


class Bench:
    """Navigation service of a bridge, without its ports."""

    def __init__(self, kind: str, options: NavigationOptions = OPTIONS) -> None:
        self.component = Component(
            Link("udpout:127.0.0.1:14550"), {"MAG_NAVIGATION": -1.0}, start_us=START_US
        )
        self.navigation = NavigationService(
            hills(), options, FIX_MESSAGES[kind]._replace(rate=0.0), self.component
        )
        self.texts: list[str] = []
        self._autopilot = {number: Codec(1, number) for number in (1, 197)}
        self.now_us = START_US

    def to(self, seconds: float) -> list[Message]:
        """Advance the time to `seconds` after the start; return the messages sent, and store the texts."""
        self.now_us = START_US + round(seconds * 1e6) // 4 * 4
        self.component.output.advance(self.now_us)
        return self._drain()

    def receive(self, name: str, component: int = 1, **fields: Any) -> list[Message]:
        """Deliver a message of the autopilot's `component` now; return the messages sent."""
        frame = self._autopilot[component].pack(name, **fields)
        for message in self.component.receive(frame, self.now_us):
            self.navigation.receive(message, self.now_us)
        return self._drain()

    def fix(self, sigma: float = 5.0) -> list[Message]:
        """Offer a position of `sigma` (m) to the fix sender; return the messages sent."""
        at = Reckoned(self.now_us, *PLACE, sigma**2, 0.0, sigma**2)
        if self.navigation.fixing.send(at, 0):
            self.navigation.motion.fixes_sent()
        return self._drain()

    def texts_with(self, word: str) -> list[str]:
        """Return the new texts that contain `word`, and discard all others."""
        self._drain()
        found, self.texts = [text for text in self.texts if word in text], []
        return found

    def _drain(self) -> list[Message]:
        self.texts += [text for _, text in self.component.output.texts]
        self.component.output.texts.clear()
        frames = b"".join(frame for _, frame in self.component.output.drain())
        wanted = ("COMMAND_INT", "COMMAND_LONG", "GLOBAL_POSITION_SENSOR", "ODOMETRY")
        return [message for message in Codec(255, 190).parse(frames) if message.name in wanted]
