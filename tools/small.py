"""Make small calibrations, and bridges without ports, for tests and studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.bridge.events import StartEvent
from magbridge.bridge.pipeline import Pipeline, set_up
from magbridge.calibration.file import save
from magbridge.calibration.model import Boresight, Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.config import load

START = 1_780_000_000_000_000
BEGIN = StartEvent(START)
BATTERY = Parameter("battpos", "", -1.0, 1.0, 0.0, 1.0)
ASCII_OPTIONS = 'columns = ["x", "y", "z", "temperature", "time", "sequence"]'


def bridge_text(
    driver: str = "ascii",
    options: str = ASCII_OPTIONS,
    *,
    port: str = "/dev/null",
    url: str = "udpout:127.0.0.1:14550",
    masses: Mapping[str, str] = MappingProxyType({"battpos": ""}),
    calibration: bool = True,
    log: bool = True,
    publish: Mapping[str, int] = MappingProxyType({}),
    more: str = "",
) -> str:
    """Return the text of a ``bridge.toml`` with a sensor `driver`, its `options` in TOML, and its `port`.

    `masses` is the unit of each telemetry name. With `calibration` the bridge uses the file ``cal.json``;
    with `log` it writes to the folder ``logs``. `publish` has rates of messages. `more` is text after the
    table ``[publish]``, so it can begin with keys of this table.
    """
    lines = ["[sensor]", f'driver = "{driver}"', f'port = "{port}"', f"options = {{{options}}}"]
    lines += ["[link]", f'url = "{url}"']
    lines += ["[calibration]", 'file = "cal.json"'] * calibration
    for name, unit in masses.items():
        lines += [f"[telemetry.{name}]", 'message = "NAMED_VALUE_FLOAT"', f'match = {{name = "{name}"}}']
        lines += ['field = "value"', f'unit = "{unit}"']
    lines += ["[log]", 'directory = "logs"'] * log + ["[publish]"] * bool(publish)
    lines += [f"{message} = {rate}" for message, rate in publish.items()]
    return "\n".join([*lines, more])


def polynomial(
    coefficients: FloatArray,
    *parameters: Parameter,
    variance: float = 1.0,
    noise_nt: float = 1.0,
    field_nt: float = 50_000.0,
    **more: Any,
) -> Calibration:
    """Return a polynomial calibration with this `variance` (nT²) of each coefficient, and `more` fields."""
    size = len(coefficients)
    orders = (full_order(len(parameters), order) for order in count())
    exponents = next(one for one in orders if 9 * len(one) >= size)
    return Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=coefficients,
        noise=Noise(noise_nt),
        reference=Reference(field_nt),
        **{"covariance": variance * np.eye(size), "method": "auto", **more},
    )


def aligned(variance: float = 1e-6) -> Boresight:
    """Return the boresight of a sensor aligned with the body; each angle has a `variance`, rad²."""
    return Boresight((0.0, 0.0, 0.0), ((variance, 0.0, 0.0), (0.0, variance, 0.0), (0.0, 0.0, variance)))


def write_bridge(folder: Path, known: Calibration, /, **settings: Any) -> Path:
    """Write a calibration and a ``bridge.toml`` with `settings` of :func:`bridge_text`; return its path."""
    save(known, folder / "cal.json")
    path = folder / "bridge.toml"
    path.write_text(bridge_text(**settings), encoding="utf-8")
    return path


def small_bridge(
    folder: Path,
    publish: Sequence[str] = ("MAG_FIELD",),
    start: StartEvent = BEGIN,
    battery: Parameter = BATTERY,
    more: str = "",
    boresight: Boresight | None = None,
    options: str = ASCII_OPTIONS,
) -> Pipeline:
    """Return a bridge that is configured in a folder and to which the caller feeds events.

    The mass `battery` is the telemetry column ``battpos``; the bridge sends the messages `publish` with every
    sample. `more` and `options` are arguments of :func:`bridge_text`. With a `boresight` in the calibration,
    the bridge computes a heading.
    """
    coefficients = np.random.default_rng(1).normal(size=4 * 9) * 300.0
    known = polynomial(coefficients, battery, boresight=boresight)
    rates = dict.fromkeys(publish, 0)
    return set_up(load(write_bridge(folder, known, publish=rates, more=more, options=options)), start)
