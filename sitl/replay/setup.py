"""Set up a replay from a log alone: write a configuration, and fit a calibration to part of the log.

The fit omits the last of several files, or the last third of a single file. Only the error of this part is
out of sample.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import BoolArray, FloatArray
from magbridge.calibration.file import save
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.columns import CHANNELS, COLUMNS
from magbridge.errors import CalibrationError, FormatError
from magbridge.logs import Options, read
from magbridge.logs.telemetry_writer import short_name
from sitl.scenario import load
from sitl.twin import simulate_like

FULL_SCALE = 100_000.0
"""Range of the emulated fluxgate to either side of zero, nT."""
SENSITIVITY = 5e-5
"""Sensitivity of the emulated fluxgate, V/nT."""
TIMEOUT = 10.0
"""Shortest time without a reading after which the bridge reports a silent sensor, s."""
SETTLE_TIME = 4.0
"""Settling time after a mass has moved, s: eight time constants of the paper's anti-alias filter."""


class Part(NamedTuple):
    """Part of the deployment: a file, or a third of a single file."""

    name: str
    begin: float
    end: float
    """`begin`, `end`: Times of the first and the last sample, s since 1970 UTC."""


class ReplaySetup(NamedTuple):
    """Deployment with all that its replay needs."""

    config: Path
    """Path of the written ``bridge.toml``."""
    deployment: xr.Dataset
    parts: list[Part]
    """Parts in order of time; the calibration does not use the last one."""
    calibration: str
    """Origin of the calibration, or the reason why there is none."""
    simulated: bool
    """True if the log has no magnetometer, so that its field is simulated from its telemetry."""


def prepare(files: Sequence[Path], folder: Path, options: Options) -> ReplaySetup:
    """Read logs, fit a nominal calibration to all but the last part, and write both to `folder`.

    Raises
    ------
    FormatError
        A file cannot be read, or the logs have neither a magnetic field nor the columns to simulate one.
    """
    deployment = read(files, options=options)
    simulated = not set(CHANNELS) <= set(deployment)
    if simulated:
        deployment = simulate_like(deployment, load("comet"))
    parts = _parts(files, deployment, options)
    summary = _calibrate(deployment, parts, folder / "cal.json")
    config = folder / "bridge.toml"
    names, steps = telemetry_of(deployment), np.diff(deployment["time"].to_numpy())
    timeout = max(TIMEOUT, 3.0 * float(np.median(steps))) if steps.size else TIMEOUT
    text = bridge_toml(deployment, names, calibrated=summary.startswith("nominal"), timeout=timeout)
    config.write_text(text, encoding="utf-8")
    return ReplaySetup(config, deployment, parts, summary, simulated)


def _parts(files: Sequence[Path], deployment: xr.Dataset, options: Options) -> list[Part]:
    """Return the time spans of the files, or thirds of a single one; files of one stem are one part."""
    time = deployment["time"].to_numpy()
    stems = list(dict.fromkeys(file.stem for file in files))
    if len(stems) == 1:
        edges = np.linspace(time[0], time[-1], 4)
        names = ("first third", "second third", "last third")
        return [Part(*part) for part in zip(names, edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    spans: list[Part] = []
    few = deployment.sizes["time"] / len(stems) / 10
    for stem in stems:
        own = read([file for file in files if file.stem == stem], options=options)["time"].to_numpy()
        if spans and len(own) < few:  # a few rows at the surface join the previous part
            spans[-1] = spans[-1]._replace(end=float(own[-1]))
        else:
            spans.append(Part(stem, float(own[0]), float(own[-1])))
    return sorted(spans, key=lambda part: part.begin)


def rows_of(part: Part, time: FloatArray) -> BoolArray:
    """Return a mask (n,) of the times (s since 1970) that belong to a part."""
    return (time >= part.begin) & (time <= part.end)


def _calibrate(deployment: xr.Dataset, parts: Sequence[Part], path: Path) -> str:
    """Fit and save a nominal calibration to all but the last part; return its origin, or the error."""
    held_out = rows_of(parts[-1], deployment["time"].to_numpy())
    try:
        found = fit(observations(deployment.isel(time=~held_out), ()), "nominal")
    except (CalibrationError, FormatError) as error:
        return f"none: {error}"
    save(found.calibration, path)
    first, last = parts[0].name, parts[-2].name
    fitted = first if first == last else f"{first} to {last}"
    return f"nominal, fitted on {fitted}: {found.rms:.1f} nT RMS there"


def bridge_toml(
    deployment: xr.Dataset, names: Iterable[str], *, calibrated: bool, log: str = "", timeout: float = TIMEOUT
) -> str:
    """Return a ``bridge.toml`` for an emulated digitizer, with the columns `names` as parameters."""
    lines = [
        "[sensor]",
        'driver = "digitizer"',
        f"timeout = {timeout:.1f}",
        'port = "/dev/null"  # a replay puts its own pty here',
        "[sensor.options]",
        f"sensitivity = {SENSITIVITY}",
        f"reference_voltage = {SENSITIVITY * FULL_SCALE}",
        "[link]",
        'url = "udpout:127.0.0.1:14550"  # and its own socket here',
        "[publish]",
        "MAG_RAW = 0",
        "MAG_FIELD = 0",
        "HIGHRES_IMU = 0",
    ]
    if calibrated:
        lines += ["[calibration]", 'file = "cal.json"']
        lines += ["[align]", f"settle_time = {SETTLE_TIME}"]
    if log:
        lines += ["[log]", f'directory = "{log}"']
    for name, short in short_names(names).items():
        unit = str(deployment[name].attrs.get("units", "")).replace('"', "")
        lines += [
            f'[telemetry."{name}"]',
            'message = "NAMED_VALUE_FLOAT"',
            f'match = {{name = "{short}"}}',
            'field = "value"',
            f'unit = "{unit}"',
        ]
    return "\n".join(lines) + "\n"


def telemetry_of(deployment: xr.Dataset) -> list[str]:
    """Return the names of the non-standard columns whose names a ``bridge.toml`` allows."""
    names = (str(name) for name in deployment.data_vars)
    return [
        name
        for name in names
        if name not in COLUMNS
        and not name.startswith(("truth_", "mag"))
        and re.fullmatch(r"\w+", name, re.ASCII)
    ]


def short_names(names: Iterable[str]) -> dict[str, str]:
    """Return a unique short name, for a NAMED_VALUE_FLOAT, for each of `names`."""
    short: dict[str, str] = {}
    for name in names:
        short[name] = short_name(name, short.values())
    return short
