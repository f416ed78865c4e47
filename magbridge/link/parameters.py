"""Parameters that can be changed over the link, the senders that may change them, and MAVLink's protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from struct import pack, unpack

import msgspec

from magbridge.config import Align, Telemetry
from magbridge.link.output import Output
from magbridge.mavlink import Message
from magbridge.mavlink.enums import MAV_PARAM_TYPE, MAV_SEVERITY, MAV_TYPE

__all__ = [
    "ParameterService", "Parameters", "Tunable", "alignment", "file_rate", "learning", "rate_name", "rates",
    "telemetry_ages",
]  # fmt: skip


class Tunable(msgspec.Struct, frozen=True):
    """Definition of one parameter that can be changed over the link."""

    name: str
    """Name on the link, at most 16 characters."""
    key: str
    """Dotted key in the configuration."""
    default: float
    low: float
    high: float
    """`default`, `low`, `high`: Default, smallest and largest value, in `unit`."""
    unit: str
    doc: str
    """Description in one line."""


def alignment(align: Align) -> list[Tunable]:
    """Return the parameters of the section ``[align]``."""
    earths = "the Earth's field about the main field"
    rows = (
        ("MB_FILT_DELAY", "filter_delay", 0, 60, "s", "delay of the anti-alias filter"),
        ("MB_GAP_FACTOR", "gap_factor", 1.01, 1000, "", "sample periods without a sample that are a gap"),
        ("MB_MOVING_RATE", "moving_rate", 1e-6, 10, "1/s", "ranges per second from which on a mass moves"),
        ("MB_SETTLE_TIME", "settle_time", 0, 3600, "s", "how long samples stay flagged after a motion"),
        ("MB_STALE_GROW", "stale_growth", 0, 1e4, "nT/s", "growth of sigma with the age of stale telemetry"),
        ("MB_REF_SIGMA", "reference_sigma", 1e-3, 1e9, "nT", f"1-sigma of {earths}"),
        ("MB_TURNON_SIGMA", "turn_on_sigma", 0, 1e5, "nT", "1-sigma of the offset's change at power-on"),
    )
    return [
        Tunable(name, f"align.{key}", float(getattr(align, key)), low, high, unit, doc)
        for name, key, low, high, unit, doc in rows
    ]


def file_rate() -> list[Tunable]:
    """Return the parameter for the rate at which files are sent, as a list of one."""
    doc = "at which files are sent to stations; 0 sends none"
    return [Tunable("MB_FILE_RATE", "files.rate", 250.0, 0, 10_000, "kB/s", doc)]


def learning(enabled: bool) -> list[Tunable]:
    """Return the parameters of the section ``[learning]``; `enabled` is the default of MB_LEARN."""
    rows = (
        ("MB_LEARN", "enabled", float(enabled), 1, "whether the calibration is learned in flight"),
        ("MB_LEARN_FREEZE", "freeze", 0.0, 1, "1: compare and raise alarms, but learn nothing"),
        ("MB_LEARN_CMD", "cmd", 0.0, 2, "1 accepts the learned calibration, 2 forgets it; goes back to 0"),
    )
    return [
        Tunable(name, f"learning.{key}", default, 0, high, "", doc) for name, key, default, high, doc in rows
    ]


def telemetry_ages(telemetry: Mapping[str, Telemetry]) -> list[Tunable]:
    """Return one parameter for the ``max_age`` of each telemetry value."""
    rows: dict[str, Tunable] = {}
    for number, (name, what) in enumerate(telemetry.items()):
        short = f"MB_AGE_{name.upper()}"[:16]
        if short in rows:
            short = f"MB_AGE_{number}"
        rows[short] = Tunable(
            short, f"telemetry.{name}.max_age", what.max_age, 0.01, 1e6, "s", f"older {name} is stale"
        )
    return list(rows.values())


def rate_name(message: str) -> str:
    """Return the name of the parameter that holds the rate of `message`."""
    return f"MB_R_{message.removeprefix('MAG_')}"[:16]


def rates(defaults: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> list[Tunable]:
    """Return one parameter for the rate (Hz) of each message in `limits`; without a default, it is off."""
    doc = "rate of {}; 0 with every sample, -1 off"
    return [
        Tunable(rate_name(of), f"publish.{of}", defaults.get(of, -1.0), low, high, "Hz", doc.format(of))
        for of, (low, high) in limits.items()
    ]


def real32(value: float) -> float:
    """Return `value` rounded to float32, the type of a parameter in a message."""
    return float(unpack("<f", pack("<f", value))[0])


class Parameters:
    """Current values of the parameters.

    A value equal to the default is not rounded to float32, so that a bridge with unchanged parameters uses
    exactly the numbers of the configuration.

    `table`: the definitions by name, in the order of the parameters' index on the link.
    `revision`: number of changes so far.
    """

    def __init__(self, table: Iterable[Tunable]) -> None:
        self.table = {row.name: row for row in table}
        self.names = list(self.table)
        self.revision = 0
        self._watchers: list[tuple[str, Callable[[str], None]]] = []
        self._values = {row.name: float(row.default) for row in self.table.values()}
        self._names_of = {row.key: row.name for row in self.table.values()}

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def value_of(self, key: str) -> float:
        """Return the value of the parameter with the configuration key `key`."""
        return self._values[self._names_of[key]]

    def changed(self) -> dict[str, float]:
        """Return the values that differ from their defaults, by name; the bridge stores these values."""
        return {name: value for name, value in self._values.items() if value != self.table[name].default}

    def watch(self, watcher: Callable[[str], None], only: str = "") -> None:
        """Register a function to call with a parameter's name after each change, of all or `only` one."""
        self._watchers.append((only, watcher))

    def set(self, name: str, value: float) -> bool:
        """Set a value and return True; return False and change nothing if it is NaN or out of range."""
        row = self.table[name]
        if not isfinite(value) or abs(value) > 1e38:
            return False
        short = real32(value)
        if not real32(row.low) <= short <= real32(row.high):
            return False
        if short == real32(self._values[name]):
            return True
        self._values[name] = row.default if short == real32(row.default) else short
        self.revision += 1
        for only, watcher in self._watchers:
            if only in ("", name):
                watcher(name)
        return True

    def restore(self, values: Mapping[str, float]) -> list[str]:
        """Set the values stored by an earlier run; return names that are unknown or have invalid values."""
        return [name for name, value in values.items() if name not in self.table or not self.set(name, value)]


PACE_US = 20_000
"""Time between two values when all parameters are sent, µs: 50 a second, which a slow radio can transmit."""
LIST_INTERVAL_US = 10_000_000
"""Time after which the parameters are sent to a new station a second time, µs."""
FORGOTTEN_US = 60_000_000
"""Time without a heartbeat after which a station counts as new again, µs."""
MAX_SENDERS = 64
"""Most components whose last heartbeat is stored; a further one displaces the one silent for longest."""


class ParameterService:
    """Handler of PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; all values are REAL32.

    Only the autopilot and ground stations may change parameters and rates. A ground station is a component
    with a HEARTBEAT of type GCS. A component of another system without a heartbeat also counts as a station,
    because small programs send none. A component of our own vehicle without a heartbeat does not.

    `peer`: system id and component id of the autopilot.
    """

    def __init__(self, parameters: Parameters, output: Output, peer: tuple[int, int]) -> None:
        self._parameters, self._output, self._peer = parameters, output, peer
        self._listed = self._rounds = self._unasked = 0
        # MAV_TYPE and time (µs) of the last heartbeat of each component
        self._senders: dict[tuple[int, int], tuple[int, int]] = {}

    def may_change(self, message: Message) -> bool:
        """Return True if the sender of `message` may change the bridge's settings."""
        who = message.system, message.component
        unknown = -1 if message.system == self._peer[0] else int(MAV_TYPE.GCS)
        return who == self._peer or self._senders.get(who, (unknown, 0))[0] == MAV_TYPE.GCS

    def send(self, name: str) -> None:
        """Send PARAM_VALUE with the current value of a parameter."""
        self._output.send(
            "PARAM_VALUE",
            param_id=name,
            param_value=self._parameters[name],
            param_type=MAV_PARAM_TYPE.REAL32,
            param_count=len(self._parameters.names),
            param_index=self._parameters.names.index(name),
        )

    def heartbeat(self, message: Message) -> None:
        """Record a heartbeat; send a new station all parameters, now and `LIST_INTERVAL_US` later.

        If an autopilot is present, QGroundControl does not request the parameters of another component. It
        also discards parameters that it receives before it has the autopilot's.
        """
        who, now_us, kind = (message.system, message.component), self._output.codec.now_us, message["type"]
        _, before_us = self._senders.pop(who, (kind, now_us - FORGOTTEN_US - 1))
        self._senders[who] = kind, now_us
        if len(self._senders) > MAX_SENDERS:
            del self._senders[next(iter(self._senders))]
        if kind == MAV_TYPE.GCS and now_us - before_us > FORGOTTEN_US:
            under_way, self._unasked = self._unasked, 3
            if not under_way:
                self._list_unasked(now_us)

    def _list_unasked(self, time_us: int) -> None:
        self._unasked -= 1
        if self._unasked:
            self.list()
            self._output.run_once("parameters unasked", time_us + LIST_INTERVAL_US, self._list_unasked)

    def list(self, message: Message | None = None) -> None:  # noqa: ARG002 - every handler takes one
        """Start to send all parameters, one every `PACE_US`; if a list is being sent, complete it first."""
        if not self._rounds:
            self._listed = 0
            self._output.every("parameters", PACE_US, self._send_next, self._output.codec.now_us)
        self._rounds = 2 if self._listed else 1

    def _send_next(self, _: int) -> None:
        self.send(self._parameters.names[self._listed])
        self._listed += 1
        if self._listed == len(self._parameters.names):
            self._listed = 0
            self._rounds -= 1
        if not self._rounds:
            self._output.cancel("parameters")

    def read(self, message: Message) -> None:
        """Send the parameter of a request, which has an index or a name; ignore unknown parameters."""
        index = message["param_index"]
        names = self._parameters.names
        if index != -1 and message["target_component"] == 0:
            return  # a broadcast: the same index is a different parameter in every component
        name = message["param_id"] if index == -1 else names[index] if 0 <= index < len(names) else ""
        if name in self._parameters.table:
            self.send(name)

    def write(self, message: Message) -> None:
        """Set a parameter if the request is valid and permitted; reply with its value, changed or not."""
        name, value = message["param_id"], message["param_value"]
        row = self._parameters.table.get(name)
        if row is None:
            return
        if message["param_type"] != MAV_PARAM_TYPE.REAL32:
            self._refuse(name, "only REAL32 is taken")
        elif not self.may_change(message):
            who = f"{message.system}:{message.component}"
            self._refuse(name, f"only a station or the autopilot sets it, not {who}")
        elif not self._parameters.set(name, value):
            limits = f"{row.low:.6g} to {row.high:.6g} {row.unit}".rstrip()
            self._refuse(name, f"{value:.6g} is not within {limits}")
        else:
            text = f"{name} = {value:.6g}, set by {message.system}:{message.component}"
            self._output.announce(f"set {name}", text, MAV_SEVERITY.NOTICE)
        self.send(name)

    def _refuse(self, name: str, reason: str) -> None:
        self._output.announce(f"refused {name}", f"{name}: {reason}", MAV_SEVERITY.WARNING, recurring=True)
