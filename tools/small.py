"""A bridge without ports, for tests and studies: line protocol, one mass, random coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from magbridge.bridge.events import StartEvent
from magbridge.bridge.pipeline import Pipeline, set_up
from magbridge.calibration.file import save
from magbridge.calibration.model import Boresight, Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.config import load

START = 1_780_000_000_000_000
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

    `masses` is the telemetry by name, with its unit. With `calibration` the bridge has the file ``cal.json``,
    with `log` it writes to the folder ``logs``. `publish` has rates of messages; `more` are further lines,
    first more keys of ``[publish]``, if any.
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


def small_bridge(
    folder: Path,
    start: StartEvent,
    battery: Parameter,
    publish: Sequence[str],
    more: str = "",
    boresight: Boresight | None = None,
) -> Pipeline:
    """Return a bridge that is configured in a folder; events are fed by hand.

    The mass `battery` is the telemetry column ``battpos``; the messages `publish` are sent with every sample.
    `more` is that of :func:`bridge_text`. With the `boresight` of its calibration the bridge computes a
    heading.
    """
    size = 4 * 9
    cal = Calibration(
        parameters=(battery,),
        terms=(Polynomial(exponents=full_order(1, 3)),),
        coefficients=np.random.default_rng(1).normal(size=size) * 300.0,
        covariance=np.eye(size),
        noise=Noise(1.0),
        reference=Reference(50_000.0),
        boresight=boresight,
        method="auto",
    )
    save(cal, folder / "cal.json")
    config = folder / "bridge.toml"
    config.write_text(bridge_text(publish=dict.fromkeys(publish, 0), more=more), encoding="utf-8")
    return set_up(load(config), start)
