"""A commented ``bridge.toml`` from the answers to five questions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from magbridge.calibration.model import Calibration
from magbridge.columns import TEMPERATURE
from magbridge.logs.fields import field_maps
from magbridge.sensors.options import options_of

__all__ = ["PLACEHOLDER", "Answers", "bridge_toml"]

PLACEHOLDER = "FILL IN"
"""Mark of a setting that the user must complete."""


@dataclass(frozen=True)
class Answers:
    """The settings of a vehicle's bridge that have no default."""

    driver: str
    port: str
    """`driver`, `port`: The sensor's."""
    baudrate: int = 9600
    link: str = "udpout:127.0.0.1:14550"
    """The MAVLink URL."""
    system: int = 1
    """The vehicle's system id."""
    parameters: tuple[str, ...] = ()
    """``name`` or ``name [unit]`` of each moving mass."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the driver."""
    calibration: str | None = None
    """Its file."""


def bridge_toml(answers: Answers, calibration: Calibration | None = None) -> str:
    """Return the text of the configuration, with a comment at every key.

    `answers`: what the user said.
    `calibration`: its parameters get a table each, in its own units.
    ConfigError: no such driver.
    """
    units = dict(map(_named, answers.parameters))
    if calibration is not None:
        own = calibration.units
        units = {**{name: own.get(name, "") for name in calibration.channels if name != TEMPERATURE}, **units}
    return "\n".join(
        [
            "# What each key means, and all others: magbridge's documentation, 'On a vehicle'.",
            "# magbridge run --check --config THIS says what would go wrong; with --live, what arrives.",
            "",
            *_sensor(answers),
            "",
            "[link]",
            f"url = {_text(answers.link)}    # udpin:, udpout:, tcp:, tcpin: HOST:PORT, or a serial device",
            f"system = {answers.system}    # the vehicle's system id, the only one listened to",
            "component = 191    # our own id: an onboard computer",
            "",
            *_telemetry(units),
            *_calibration(answers.calibration),
            "",
            "[publish]    # message = rate in Hz; 0: with every sample; negative: never",
            "MAG_FIELD = 0",
            "HIGHRES_IMU = 0",
            "NAMED_VALUE_FLOAT = 1",
            "",
            "[log]    # every byte that comes and goes: a run can be replayed",
            'directory = "logs"    # relative to this file',
            "",
        ]
    )


def _sensor(answers: Answers) -> list[str]:
    lines = [
        "[sensor]",
        f"driver = {_text(answers.driver)}",
        f"port = {_text(answers.port)}    # a device, a pattern (/dev/ttyUSB*), or socket://HOST:PORT",
        f"baudrate = {answers.baudrate}",
        "# timeout = 10.0    # s without a reading, then the sensor counts as silent",
        "[sensor.options]",
    ]
    for one in options_of(answers.driver):
        meaning = one.meaning.replace("``", "").partition(". ")[0].rstrip(".")
        if one.name in answers.options:
            lines.append(f"{one.name} = {_value(answers.options[one.name])}    # {meaning}")
        elif one.required:
            lines.append(f"# {one.name} =     # {PLACEHOLDER}: {meaning}")
        elif one.default is not None:
            lines.append(f"# {one.name} = {_value(one.default)}    # {meaning}")
        else:
            lines.append(f"# {one.name} =     # {meaning}")
    return lines


def _telemetry(units: dict[str, str]) -> list[str]:
    if not units:
        return [
            "# [telemetry.battpos]    # a table for each moving mass: any field of any MAVLink message",
            '# message = "NAMED_VALUE_FLOAT"',
            '# match = {name = "battpos"}',
            '# field = "value"',
            '# unit = "in"',
            "# max_age = 30.0    # s; an older value is stale",
            "",
        ]
    lines = []
    for name, unit in units.items():
        lines += [
            f"[telemetry.{_key(name)}]    # any field of any MAVLink message; value = scale * field + offset",
            *_source(name, unit),
            f"unit = {_text(unit)}    # the calibration's",
            "max_age = 30.0    # s; an older value is stale",
            "",
        ]
    return lines


def _source(name: str, unit: str) -> list[str]:
    """Return the keys of the message that carries a parameter: the autopilot's own one if known.

    The columns that magbridge reads from a telemetry log are named in ``logs/fields.csv``; a calibration that
    was fitted to such a log has these names.
    """
    for fields in field_maps("mavlink").values():
        for one in fields:
            if one.column == name and unit in ("", one.unit):
                scale = [f"scale = {one.factor:g}"] if one.factor != 1.0 else []
                return [f'message = "{one.record}"', f'field = "{one.field}"', *scale]
    return [
        'message = "NAMED_VALUE_FLOAT"',
        f"match = {{name = {_text(name[:10])}}}    # at most 10 characters",
        'field = "value"',
    ]


def _calibration(file: str | None) -> list[str]:
    if file is None:
        return [
            "# [calibration]    # from magbridge calibrate; without one, samples are sent as uncalibrated",
            '# file = "cal.json"',
        ]
    return ["[calibration]", f"file = {_text(file)}    # from magbridge calibrate; relative to this file"]


def _named(text: str) -> tuple[str, str]:
    name, _, unit = text.partition("[")
    return name.strip(), unit.rstrip("] ")


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else _text(name)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a JSON string is a TOML string


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)
