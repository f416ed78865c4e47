"""Replay a log through the real bridge: sensor bytes through a pty, MAVLink through a socket."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from magbridge.arrays import FloatArray, IndexArray
from magbridge.bridge.events import StartEvent
from magbridge.columns import CHANNELS
from magbridge.config import load
from magbridge.errors import DataError, WrongUse
from magbridge.field.reference import reference_field
from magbridge.logs import Options, read
from magbridge.logs.deployment import passed_over
from magbridge.progress import track
from sitl.replay.emulation import emulate, start_us
from sitl.replay.listener import Listener
from sitl.replay.own_log import Recorded, is_own_log, runs
from sitl.replay.setup import Part, prepare, rows_of
from sitl.replay.stage import Stage

__all__ = ["agreement", "replay", "summary"]

Result = dict[str, Any]
DEFAULTS = Options()


def replay(
    files: Sequence[Path],
    config: Path | None = None,
    speed: float = inf,
    log: Path | None = None,
    options: Options = DEFAULTS,
) -> Result:
    """Replay `files` through the bridge; return the results for :func:`summary`.

    From a bridge's own log (all its files, in order), the bridge must publish the same bytes again. For other
    logs, two emulated devices send magnetometer data and telemetry. Without a `config`, a nominal calibration
    is fitted to all but the last file. `speed` is the ratio to real time, `log` the folder for the bridge's
    log of the replay, `options` are for reading other logs.

    Raises
    ------
    DataError
        A log lacks one of the three channels, or has only one row.
    WrongUse
        A bridge's own log comes without its configuration, with `options`, or with other logs.
    """
    if config is not None:
        load(config)  # a faulty configuration is reported before anything begins
    if own := next((file for file in files if is_own_log(file)), None):
        if other := next((file for file in files if file.suffix.lower() != own.suffix.lower()), None):
            raise WrongUse(f"{other}: cannot be replayed together with {own}, a bridge's own log")
        if config is None:
            raise WrongUse(f"{own} is a bridge's own log: name its configuration with --config")
        if options != DEFAULTS:
            raise WrongUse(f"{own} is a bridge's own log: it is read as it is, without options")
        return {"runs": [_republished(run, config, speed, log) for run in runs(files)]}
    if config is not None:
        deployment = read(files, required=CHANNELS, options=options)
        times = deployment["time"].to_numpy()
        parts = [Part("all", float(times[0]), float(times[-1]))]
        return _play(deployment, config, parts, speed, log)
    with tempfile.TemporaryDirectory() as folder:
        setup = prepare(files, Path(folder), options)
        result = _play(setup.deployment, setup.config, setup.parts, speed, log)
    result |= {"calibration": setup.calibration, "simulated_field": setup.simulated}
    result["parts"][-1]["held_out"] = setup.calibration.startswith("nominal")
    return result


def _republished(files: Sequence[Path], config: Path, speed: float, log: Path | None) -> Result:
    """Replay a bridge's own log, and compare the output with the logged output."""
    recorded = Recorded(files)
    published = bytearray()
    stage = Stage(config, published.extend, log)
    begun = time.monotonic()
    stage.play(recorded.start, track(recorded.events(), "replaying"), speed)
    first = _first_difference(published, recorded.published)
    beyond = max(len(published) - len(recorded.published), 0)
    return agreement(published, recorded) | {
        "files": [str(file) for file in files],
        "messages": recorded.messages,
        "bytes": len(recorded.published),
        "identical": first is None,
        "first_difference": first,
        "beyond": beyond,
        "is_cut": first == len(recorded.published) and beyond > 0,
        "same_config": load(config).digest == recorded.config_digest,
        "damages": recorded.damages,
        "seconds": time.monotonic() - begun,
    }


def agreement(published: bytearray, recorded: Recorded) -> Result:
    """Compare the total field sample by sample, if the log begins after the start of its run.

    For a complete log, return only that it begins at 0 s, because its bytes are compared.
    """
    if not recorded.late:
        return {"late_s": 0.0}
    ours, theirs = (_received(stream) for stream in (published, recorded.published))
    count = len(theirs["time"]) if len(ours["time"]) else 0
    off = np.zeros(0)
    if count:
        off = ours["total_field"][_nearest(ours["time"], theirs["time"])] - theirs["total_field"]
    known = np.abs(off[np.isfinite(off)])
    return {
        "late_s": recorded.late,
        "samples": count,
        "same_samples": int(np.count_nonzero(known == 0.0)),
        "worst_nT": float(known.max()) if len(known) else None,
    }


def _received(stream: bytearray) -> dict[str, FloatArray]:
    listener = Listener()
    listener.receive(bytes(stream))
    return listener.field()


def _first_difference(first: bytearray, second: bytearray) -> int | None:
    """Return the index of the first byte at which two streams differ; None if they are equal."""
    if first == second:
        return None
    size = min(len(first), len(second))
    different = np.flatnonzero(
        np.frombuffer(first[:size], np.uint8) != np.frombuffer(second[:size], np.uint8)
    )
    return int(different[0]) if len(different) else size


def _play(
    deployment: xr.Dataset, config: Path, parts: Sequence[Part], speed: float, log: Path | None
) -> Result:
    """Replay a deployment by emulated devices, and compare the corrected field with the reference."""
    if deployment.sizes["time"] < 2:
        raise DataError(f"{deployment.attrs['source']}: one row: at least 2 needed")
    if start_us(deployment) < 0:
        source = deployment.attrs["source"]
        raise DataError(f"{source}: a replay needs times after 1970; --date dates times from a boot")
    listener = Listener()
    stage = Stage(config, listener.receive, log)
    begun = time.monotonic()
    events = track(emulate(deployment, load(config)), "replaying")
    stage.play(StartEvent(start_us(deployment)), events, speed)
    seconds = time.monotonic() - begun
    field = listener.field()
    if not len(field["time"]):
        raise DataError(f"{deployment.attrs['source']}: no row holds a reading of all three channels")
    times = deployment["time"].to_numpy()
    raw = np.hypot.reduce([deployment[name].to_numpy() for name in CHANNELS])
    reference = _reference(deployment)
    nearest = _nearest(times, field["time"])
    error, uncorrected = field["total_field"] - reference[nearest], (raw - reference)[nearest]
    compared = [_compared(part, times[nearest], uncorrected, error, field["sigma"]) for part in parts]
    return {
        "samples": len(field["time"]),
        "rows": len(times),
        "messages": dict(sorted(listener.counts.items())),
        "flags": listener.flags(),
        "said": listener.texts,
        "navigation": dict(listener.navigation),
        "span_s": float(times[-1] - times[0]),
        "seconds": seconds,
        "parts": compared,
        "skipped": passed_over(deployment.attrs),
    }


def _compared(
    part: Part, times: FloatArray, raw: FloatArray, corrected: FloatArray, sigma: FloatArray
) -> Result:
    """Return the statistics of one part from the raw and corrected errors and sigmas (n,), nT."""
    rows = rows_of(part, times)
    error = corrected[rows]
    known = np.isfinite(error)
    return {
        "name": part.name,
        "samples": int(rows.sum()),
        "raw_rms_nT": _rms(raw[rows]),
        "corrected_rms_nT": _rms(error),
        "corrected_mean_nT": float(error[known].mean()) if known.any() else None,
        "sigma_nT": _rms(sigma[rows]),
        "held_out": False,
    }


def _nearest(times: FloatArray, wanted: FloatArray) -> IndexArray:
    """Return the index of the row whose time (ascending) is nearest to each wanted time."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    return after - (wanted - times[after - 1] < times[after % len(times)] - wanted)


def _reference(deployment: xr.Dataset) -> FloatArray:
    """Return the reference total field (n,), nT; NaN if unknown."""
    try:
        return reference_field(deployment)
    except DataError:
        return np.full(deployment.sizes["time"], np.nan)


def _rms(values: FloatArray) -> float | None:
    """Return the root mean square of the finite values; None if no value is finite."""
    values = values[np.isfinite(values)]
    with np.errstate(over="ignore"):  # the square of an absurd value may overflow to infinity
        return float(np.sqrt(np.mean(values**2))) if len(values) else None


# ---- the result in words -----------------------------------------------------------------------------------


UNKNOWN_NT = 50_000.0
"""Value above which a number counts as unknown in the summary, nT."""


def summary(result: Result) -> str:
    """Return a replay's result as text."""
    folder = FileSystemLoader(Path(__file__).parents[1])
    environment = Environment(loader=folder, undefined=StrictUndefined)  # noqa: S701 - nothing to escape
    texts: Any = environment.get_template("summary.txt", globals={"UNKNOWN_NT": UNKNOWN_NT}).module
    return "\n".join(map(texts.own_log, result["runs"])) if "runs" in result else str(texts.replayed(result))
