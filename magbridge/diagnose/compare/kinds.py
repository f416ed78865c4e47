"""The kind of quantity of a telemetry series, by its unit and its name, and the causes it may belong to.

A cause that contradicts the kind is never proposed: a throttle that the field follows is not a temperature.
Only a series without a meaningful unit or name may be of every kind.
"""

from __future__ import annotations

import re

__all__ = ["ANY", "kinds_of"]

ANY = ("temperature", "current", "pressure", "position")
DRIVE = ("current", "position")
"""Quantities of a drive: its current flows when it turns, and the part that it turns may carry iron."""
UNIT_KINDS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("degC", "K", "degF"), ("temperature",)),
    **dict.fromkeys(("A", "mA", "uA", "W", "mW"), ("current",)),
    **dict.fromkeys(("dbar", "bar", "mbar", "Pa", "hPa", "kPa"), ("pressure",)),
    **dict.fromkeys(("rpm", "1/min", "rad/s", "us", "PWM"), DRIVE),
    **dict.fromkeys(("V", "mV"), DRIVE),
}
"""Kinds of a series by its unit, where that decides."""
VAGUE = {"", "1", "%", "m"}
"""Units that any kind of series may have, or that lengths and depths share: there the name decides."""
NAME_KINDS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("temp therm", ("temperature",)),
    ("current curr amps ampere", ("current",)),
    ("press depth baro alt altitude", ("pressure",)),
    ("throttle motor thrust thruster esc rpm pwm servo prop propeller winch pump", DRIVE),
    ("pos position fin rudder elevator aileron flap ballast vbd ctl ctrl piston valve gear", ("position",)),
)
"""Kinds by the words of a name. The quantity comes first: a motor's temperature is a temperature."""
PART = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")
BEGINNING, END = 4, 3
"""Letters from which a word is also recognised as the beginning, or the end, of a longer one."""


def kinds_of(name: str, unit: str) -> tuple[str, ...]:
    """Return the kinds that a telemetry series may be, of ``temperature current pressure position``.

    Parameters
    ----------
    name : str
        The column's.
    unit : str
        As declared; empty if it is not.
    """
    if unit in UNIT_KINDS:
        return UNIT_KINDS[unit]
    parts = [part.lower() for part in PART.findall(name)]
    named = next((kinds for words, kinds in NAME_KINDS if any(_among(part, words) for part in parts)), ())
    if unit not in VAGUE:
        # of a temperature or a pressure we know the units; anything else may be what drives, or moves
        return DRIVE if named == DRIVE else ("position",)
    if unit == "m":
        return named if named in (("pressure",), ("position",)) else ("pressure",)
    return named or ANY


def _among(part: str, words: str) -> bool:
    return any(
        part == word
        or (len(word) >= BEGINNING and part.startswith(word))
        or (len(word) >= END and part.endswith(word))
        for word in words.split()
    )
