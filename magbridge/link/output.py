"""Queue of frames to send, with timers and STATUSTEXT messages, and rate limits.

All times are event times in µs since 1970 UTC, so that a replay sends the same frames at the same times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from magbridge.mavlink import Codec, Spec
from magbridge.mavlink.enums import MAV_SEVERITY

__all__ = ["FOREVER", "Output", "Rate", "period_us"]

FOREVER = 1 << 62
"""Deadline if no timer is set, µs."""
MAX_PERIOD_US = 1e15
"""Longest period of a message, µs (31 years); a rate with a longer period gets this period."""
STATUSTEXT_LENGTH = 50
"""Characters in one STATUSTEXT (definition of the message, common.xml)."""
TEXTS_KEPT = 32
"""Most STATUSTEXTs that are stored for printing to stderr."""
ANNOUNCEMENT_INTERVAL_US = 1_000_000
"""Shortest time between two STATUSTEXTs on one state, µs; a change within it is sent when it ends."""


class Output:
    """Queue of packed frames that the bridge shall send, with the timers and the STATUSTEXTs that fill it.

    Timers fire at their deadlines in event time and in the order of the deadlines, however often
    :meth:`advance` is called. A replay therefore fires the same timers at the same event times.

    `codec`: packs the messages; its ``now_us`` is the event time of the next frame.
    `frames`: event time (µs) and bytes of each frame, in the order of sending.
    `next_deadline`: event time (µs) at which the next timer fires; `FOREVER` if no timer is set.
    `texts`: severity and text of the latest STATUSTEXTs; another thread may take them out and print them.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self.frames: list[tuple[int, bytes]] = []
        self._deadlines: dict[str, int] = {}
        self._actions: dict[str, tuple[int, Callable[[int], object]]] = {}  # period in µs, and action
        self.next_deadline = FOREVER
        self.texts: deque[tuple[MAV_SEVERITY, str]] = deque(maxlen=TEXTS_KEPT)
        self._announced: dict[str, tuple[str, int]] = {}
        self._chunked_texts = 0

    def send(self, _name: str, **fields: Any) -> None:
        """Pack a message by name and queue it; fields that are not given are zero."""
        self.frames.append((self.codec.now_us, self.codec.pack(_name, **fields)))

    def put(self, layout: Spec, payload: bytes) -> None:
        """Queue a message by its payload, packed with ``layout.struct.pack(...)``; faster than `send`."""
        self.frames.append((self.codec.now_us, self.codec.frame(layout, payload)))

    def drain(self) -> list[tuple[int, bytes]]:
        """Return the queued frames and empty the queue."""
        frames, self.frames = self.frames, []
        return frames

    def every(self, name: str, period_us: int, action: Callable[[int], object], first_us: int) -> None:
        """Call ``action(deadline)`` at `first_us` and then every `period_us` (rounded down to 4 µs)."""
        self._set(name, first_us, max(period_us & ~3, 4), action)

    def run_once(self, name: str, time_us: int, action: Callable[[int], object]) -> None:
        """Call ``action(time_us)`` once, at `time_us`."""
        self._set(name, time_us, 0, action)

    def cancel(self, name: str) -> None:
        """Remove the timer `name`, if it exists."""
        if self._deadlines.pop(name, None) == self.next_deadline:
            self._find_next()

    def delay(self, name: str, delay_us: int) -> None:
        """Delay the timer `name`, if it exists, by `delay_us`, rounded down to a multiple of 4."""
        if name in self._deadlines:
            self._deadlines[name] += delay_us & ~3
            self._find_next()

    def advance(self, t_us: int) -> None:
        """Fire all timers that are due up to `t_us` (µs), and set the codec's time to `t_us`.

        Each frame has the time at which it was due. Of equal deadlines, the timer that was set first fires
        first.
        """
        while (deadline := self.next_deadline) <= t_us:
            name = next(name for name, due_us in self._deadlines.items() if due_us == deadline)
            period, action = self._actions[name]
            if period:
                self._deadlines[name] = deadline + period
            else:
                del self._deadlines[name]
            self._find_next()
            self.codec.now_us = deadline
            action(deadline)
        self.codec.now_us = t_us

    def _set(self, name: str, deadline: int, period: int, action: Callable[[int], object]) -> None:
        before = self._deadlines.get(name)
        self._deadlines[name], self._actions[name] = deadline, (period, action)
        if before == self.next_deadline or deadline < self.next_deadline:
            self._find_next()

    def _find_next(self) -> None:
        self.next_deadline = min(self._deadlines.values(), default=FOREVER)

    def send_statustext(self, text: str, severity: MAV_SEVERITY = MAV_SEVERITY.INFO) -> None:
        """Send `text`, in chunks of 50 bytes if it is longer; non-ASCII characters become question marks."""
        self.texts.append((severity, text))
        data = text.encode("ascii", "replace")
        chunks = [data[i : i + STATUSTEXT_LENGTH] for i in range(0, len(data), STATUSTEXT_LENGTH)]
        if len(chunks) > 1:
            self._chunked_texts = self._chunked_texts % 0xFFFF + 1
            if len(chunks[-1]) == STATUSTEXT_LENGTH:
                chunks.append(b"")  # the receiver waits for a chunk that is not full
        for i, chunk in enumerate(chunks):
            self.send(
                "STATUSTEXT",
                severity=severity,
                text=chunk,
                id=self._chunked_texts if len(chunks) > 1 else 0,
                chunk_seq=i,
            )

    def forget(self, key: str) -> None:
        """Delete the last announced state of `key`, so that :meth:`announce` announces the next state."""
        self._announced.pop(key, None)

    def announce(
        self, key: str, text: str, severity: MAV_SEVERITY = MAV_SEVERITY.INFO, *, recurring: bool = False
    ) -> None:
        """Send `text` as the new state of `key`, unless the last text sent for `key` was equal.

        If `recurring`, send an equal text again after `ANNOUNCEMENT_INTERVAL_US`. Send a text that changes
        within this interval when the interval ends.
        """
        now_us = self.codec.now_us
        last_text, last_us = self._announced.get(key, ("", now_us - ANNOUNCEMENT_INTERVAL_US))
        elapsed_us = now_us - last_us
        timer = f"announce {key}"
        self.cancel(timer)
        if text == last_text and not (recurring and elapsed_us >= ANNOUNCEMENT_INTERVAL_US):
            return
        if elapsed_us < ANNOUNCEMENT_INTERVAL_US:
            end_us = last_us + ANNOUNCEMENT_INTERVAL_US
            self.run_once(timer, end_us, lambda _: self.announce(key, text, severity))
            return
        self._announced[key] = text, now_us
        self.send_statustext(text, severity)


def period_us(hertz: float) -> int:
    """Return the period (µs) of a rate above 0, at most `MAX_PERIOD_US`."""
    return round(min(1e6 / hertz, MAX_PERIOD_US))


class Rate:
    """Rate limit of a stream of samples, in event time and without drift of the phase.

    `hertz`: rate in Hz; 0 passes every sample, a negative rate passes none.
    """

    __slots__ = ("_next_us", "_period_us", "hertz")

    def __init__(self, hertz: float) -> None:
        self.set(hertz)

    def set(self, hertz: float) -> None:
        """Change the rate to `hertz`; if it is positive, the next sample passes."""
        self.hertz = hertz
        self._period_us = period_us(hertz) if hertz > 0 else 0
        self._next_us = 0

    def due(self, t_us: int) -> bool:
        """Return True if the sample at `t_us` (µs) shall be sent.

        Send times differ by one period, and a sample may be early by a quarter of a period. So a stream with
        this rate passes completely in spite of jitter. After a pause of a period, or a step back by more than
        two periods, the send times restart at the sample.
        """
        if self.hertz <= 0:
            return self.hertz == 0
        ahead = self._next_us - t_us
        if ahead * 4 > self._period_us:
            if ahead <= 2 * self._period_us:
                return False
        elif ahead > -self._period_us:
            self._next_us += self._period_us
            return True
        self._next_us = t_us + self._period_us
        return True
