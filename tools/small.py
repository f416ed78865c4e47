"""A bridge without ports, for tests and studies: line protocol, one mass, random coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from magbridge.bridge.drive import set_up
from magbridge.bridge.events import Start
from magbridge.bridge.pipeline import Pipeline
from magbridge.calibration.file import save
from magbridge.calibration.model import Boresight, Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.config import load

__all__ = ["START", "small_bridge"]

START = 1_780_000_000_000_000
CONFIG = """
[sensor]
driver = "ascii"
port = "/dev/null"
options = {columns = ["x", "y", "z", "temperature", "time", "sequence"]}
[link]
url = "udpout:127.0.0.1:14550"
[calibration]
file = "cal.json"
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
[log]
directory = "logs"
[publish]
"""


def small_bridge(
    folder: Path,
    start: Start,
    battery: Parameter,
    publish: Sequence[str],
    more: str = "",
    boresight: Boresight | None = None,
) -> Pipeline:
    """Return a bridge that is configured in a folder; events are fed by hand.

    Parameters
    ----------
    folder : path
        Where its files are written.
    start : Start
        The run's start.
    battery : Parameter
        The mass, telemetry column ``battpos``.
    publish : sequence of str
        Messages that are sent with every sample.
    more : str
        Further lines of the configuration; first more keys of ``[publish]``, if any.
    boresight : Boresight or None
        That of the calibration; with one, the bridge computes a heading.
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
    published = "".join(f"{message} = 0\n" for message in publish)
    config.write_text(CONFIG + published + more, encoding="utf-8")
    return set_up(load(config), start)
