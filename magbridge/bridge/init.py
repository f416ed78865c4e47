"""Creation of a commented ``bridge.toml`` from the user's settings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from magbridge.bridge.sensor import needed_units
from magbridge.calibration.model import Calibration
from magbridge.logs.fields import field_maps
from magbridge.sensors.options import Option, options_of

__all__ = ["PLACEHOLDER", "Answers", "bridge_toml"]

PLACEHOLDER = "FILL IN"
"""Text that marks a setting which the user must complete."""


@dataclass(frozen=True)
class Answers:
    """The user's settings for a new configuration."""

    driver: str
    port: str
    """`driver`, `port`: Driver and port of the sensor."""
    baudrate: int = 9600
    link: str = "udpout:127.0.0.1:14550"
    """MAVLink URL of the link."""
    system: int = 1
    """System id of the vehicle."""
    parameters: tuple[str, ...] = ()
    """``name`` or ``name [unit]`` of the position of each moving mass."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the driver, by name."""
    calibration: str | None = None
    """Path of the calibration file; None for none."""


def bridge_toml(answers: Answers, calibration: Calibration | None = None) -> str:
    """Return the text of a ``bridge.toml``, with a comment at every key.

    `answers`: the user's settings.
    `calibration`: each of its parameters gets a ``[telemetry]`` table, in the calibration's unit.
    ConfigError: the driver does not exist.
    """
    units = needed_units(calibration) if calibration is not None else {}
    for parameter in answers.parameters:
        name, _, unit = parameter.partition("[")
        units[name.strip()] = unit.rstrip("] ")
    engine = Environment(  # noqa: S701 - TOML has nothing to escape
        loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, trim_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    engine.filters |= {"text": _text, "key": _key}
    return engine.get_template("bridge.toml.j2").render(
        answers=answers,
        options=[_option(one, answers.options) for one in options_of(answers.driver)],
        telemetry=[(name, unit, _source(name, unit)) for name, unit in units.items()],
    )


def _option(option: Option, given: Mapping[str, Any]) -> tuple[str, str, str, bool]:
    """Return name, value and meaning of a driver's option, and True if the user has set the option."""
    meaning = option.meaning.replace("``", "").partition(". ")[0].rstrip(".")
    if option.name in given:
        return option.name, _value(given[option.name]), meaning, True
    if option.required:
        return option.name, "", f"{PLACEHOLDER}: {meaning}", False
    return option.name, "" if option.default is None else _value(option.default), meaning, False


def _source(name: str, unit: str) -> Any:
    """Return the field of an autopilot's message that contains a parameter; None if no field is known.

    ``logs/fields.csv`` states the columns that magbridge reads from the messages of a telemetry log. The
    parameters of a calibration that was fitted to such a log have the names of these columns.
    """
    for fields in field_maps("mavlink").values():
        for one in fields:
            if one.column == name and unit in ("", one.unit):
                return one
    return None


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
