"""STATUSTEXT: every change of state, once, in words."""

from __future__ import annotations

from collections import deque

from magbridge.link.outbox import Outbox
from magbridge.link.timers import Timers
from magbridge.mavlink.enums import MAV_SEVERITY

__all__ = ["Announcer"]

CHUNK = 50
"""Characters in one STATUSTEXT."""
LATELY = 32
"""Texts that are kept for stderr."""
PAUSE_US = 1_000_000
"""µs between two announcements of a state that changes quickly; the latest is always announced."""


class Announcer:
    """Sends texts, and the text of a state only when the state has changed.

    Attributes
    ----------
    texts : deque of (MAV_SEVERITY, str)
        The last texts sent; another thread may take them out and print them.
    """

    def __init__(self, outbox: Outbox, timers: Timers) -> None:
        self._outbox, self._timers = outbox, timers
        self.texts: deque[tuple[MAV_SEVERITY, str]] = deque(maxlen=LATELY)
        self._last: dict[str, tuple[str, int]] = {}
        self._number = 0

    def send_statustext(self, text: str, severity: MAV_SEVERITY = MAV_SEVERITY.INFO) -> None:
        """Send `text`, in pieces where it is long; what is not ASCII becomes a question mark."""
        self.texts.append((severity, text))
        data = text.encode("ascii", "replace")
        pieces = [data[i : i + CHUNK] for i in range(0, len(data), CHUNK)]
        if len(pieces) > 1:
            self._number = self._number % 0xFFFF + 1
            if len(pieces[-1]) == CHUNK:
                pieces.append(b"")  # the receiver waits for a piece that is not full
        for i, piece in enumerate(pieces):
            self._outbox.send(
                "STATUSTEXT",
                severity=severity,
                text=piece,
                id=self._number if len(pieces) > 1 else 0,
                chunk_seq=i,
            )

    def forget(self, key: str) -> None:
        """Announce the state of `key` anew when it comes next, whatever it was."""
        self._last.pop(key, None)

    def state(
        self, key: str, text: str, severity: MAV_SEVERITY = MAV_SEVERITY.INFO, *, recurring: bool = False
    ) -> None:
        """Announce that the state of `key` is now `text`, unless that was announced last.

        A `recurring` event is announced again, but not within `PAUSE_US`.
        """
        now_us = self._outbox.codec.now_us
        texts, when_us = self._last.get(key, ("", now_us - PAUSE_US))
        timer = f"say {key}"
        self._timers.cancel(timer)
        if texts == text and not (recurring and now_us - when_us >= PAUSE_US):
            return
        if now_us - when_us < PAUSE_US:
            self._timers.at(timer, when_us + PAUSE_US, lambda _: self.state(key, text, severity))
            return
        self._last[key] = text, now_us
        self.send_statustext(text, severity)
