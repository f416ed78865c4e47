"""Rate of each message: as configured, or as requested by a station."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from magbridge.errors import ConfigError
from magbridge.link.output import Rate, Timers, period_us
from magbridge.link.parameters import Parameters, rate_name
from magbridge.link.publish import PUBLISHED
from magbridge.mavlink import Codec, spec
from magbridge.wording import one_of

__all__ = ["DEFAULT_RATES_HZ", "LIMITS", "MessageRates", "check_publish"]

LIMITS = {
    "HEARTBEAT": (0.2, 10.0),
    "MAG_STATUS": (-1.0, 10.0),
    "MAG_NAVIGATION": (-1.0, 1000.0),
    "MAG_LEARNING": (-1.0, 1000.0),
    **dict.fromkeys(PUBLISHED, (-1.0, 1000.0)),
}
"""The messages whose rate (Hz) can be set, and within which limits."""
DEFAULT_RATES_HZ = {"HEARTBEAT": 1.0, "MAG_STATUS": 1.0, "MAG_NAVIGATION": 0.0, "MAG_LEARNING": 0.1}
LONGEST_US = 0x7FFFFFFF
"""Longest interval that a MESSAGE_INTERVAL holds, µs (36 min)."""


def check_publish(publish: Mapping[str, float], path: Path) -> None:
    """Check ``[publish]``.

    ConfigError: a message that the bridge does not publish, or a rate out of range.
    """
    for name, rate in publish.items():
        if name not in LIMITS:
            raise ConfigError(path, f"publish.{name}", one_of(name, sorted(LIMITS)))
        low, high = LIMITS[name]
        if not low <= rate <= high:
            raise ConfigError(
                path, f"publish.{name}", f"expected a rate from {low:g} to {high:g} Hz, not {rate:g}"
            )


class MessageRates:
    """Rate of each message; each rate is also a parameter."""

    def __init__(self, parameters: Parameters, timers: Timers, codec: Codec) -> None:
        self._parameters, self._timers, self._codec = parameters, timers, codec
        self.by_name = {name: Rate(parameters[rate_name(name)]) for name in LIMITS}
        self._by_clock: dict[str, Callable[[], None]] = {}
        self._more: list[tuple[str, Rate]] = []
        parameters.watch(self._changed)

    def another(self, name: str) -> Rate:
        """Return one more rate of a message, with its own times: for the samples of another sensor."""
        rate = Rate(self.by_name[name].hertz)
        self._more.append((name, rate))
        return rate

    def send_by_clock(self, name: str, report: Callable[[], None]) -> None:
        """Send a message by the clock instead of with the samples; a rate of 0 is off."""
        self._by_clock[name] = report
        self._start_timer(name)

    def interval_us(self, number: int, sample_us: Callable[[], int]) -> int:
        """Return a message's interval in µs, with `sample_us` that of the samples; -1 off, 0 unknown.

        KeyError: its rate cannot be set.
        """
        hertz = self.by_name[name_of(number)].hertz
        return -1 if hertz < 0 else min(period_us(hertz) if hertz else sample_us(), LONGEST_US)

    def set(self, number: int, hertz: float | None) -> str:
        """Set a message's rate (None: the default); return the parameter's name, empty if out of range.

        KeyError: its rate cannot be set.
        """
        parameter = rate_name(name_of(number))
        value = self._parameters.table[parameter].default if hertz is None else hertz
        return parameter if self._parameters.set(parameter, value) else ""

    def _changed(self, parameter: str) -> None:
        """Apply a changed parameter if it is the rate of a message."""
        for name, rate in self._more:
            if rate_name(name) == parameter:
                rate.set(self._parameters[parameter])
        for name, rate in self.by_name.items():
            if rate_name(name) == parameter:
                rate.set(self._parameters[parameter])
                if name in self._by_clock:
                    self._start_timer(name)

    def _start_timer(self, name: str) -> None:
        hertz, report = self.by_name[name].hertz, self._by_clock[name]
        if hertz > 0:
            self._timers.every(name, period_us(hertz), lambda _: report(), self._codec.now_us)
        else:
            self._timers.cancel(name)


def name_of(number: int) -> str:
    """Return the name of a message whose rate can be set, else raise KeyError."""
    name = spec(number).name
    if name not in LIMITS:
        raise KeyError(name)
    return name
