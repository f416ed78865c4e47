"""Demonstrate the package on a simulated glider: simulate, fit, replay through the bridge, compare."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.bridge.events import StartEvent
from magbridge.calibration.file import save
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.observations import unfiltered
from magbridge.calibration.fitting.observe import observations
from magbridge.config import load as load_config
from magbridge.estimation.residual import rms
from magbridge.logs import write
from magbridge.records import Quality
from sitl.dataset import channels, corrected, segments
from sitl.replay.emulation import emulate, start_us
from sitl.replay.listener import Listener
from sitl.replay.setup import bridge_toml
from sitl.replay.stage import Stage
from sitl.scenario import load
from sitl.twin import simulate

__all__ = ["demo", "summary"]

PARAMETERS = ("battpos", "ballast")


def demo(folder: Path, seed: int = 1, notify: Callable[[str], None] = print) -> dict[str, Any]:
    """Run the demonstration; write deployment, calibration, log and plot to `folder`.

    Returns
    -------
    dict
        Errors over the survey (nT), numbers of samples, and names of the written files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()

    def step(text: str) -> None:
        notify(f"{time.monotonic() - begun:5.1f} s  {text}")

    step("simulating a glider with a moving battery and a ballast pump: calibration spirals, then a survey")
    scenario = load("demo")
    deployment = simulate(scenario, seed)
    write(deployment, folder / "deployment.nc")
    parts = segments(deployment)
    training, survey = parts["calibration"], parts["survey"]

    step(f"fitting the calibration to {training.sizes['time']} samples of the spirals")
    corner = scenario.instrument.corner
    nominal = fit(unfiltered(observations(training, ()), corner), "nominal")
    found = fit(unfiltered(observations(training, PARAMETERS), corner), "auto")
    save(found.calibration, folder / "cal.json")
    config = folder / "bridge.toml"
    config.write_text(bridge_toml(deployment, PARAMETERS, calibrated=True, log="logs"), encoding="utf-8")

    step("replaying the survey: the fluxgate through a pty, the autopilot through a socket, into the bridge")
    listener = Listener()
    stage = Stage(config, listener.receive, folder / "logs")
    stage.play(StartEvent(start_us(survey)), emulate(survey, load_config(config)), inf)
    step(f"heard {sum(listener.counts.values())} messages as a ground station would")

    received = _align(listener.field(), survey)
    result = _compare(survey, nominal, received)
    picture = folder / "demo.png"
    from sitl.demo_picture import draw  # noqa: PLC0415 - matplotlib takes a second, and comes last

    draw(survey, corrected(survey, nominal.calibration).total, received, picture)
    step(f"drew {picture}")
    files = [str(folder / name) for name in ("deployment.nc", "cal.json", "bridge.toml", "logs", "demo.png")]
    return {**result, "calibration_rms_nT": found.rms, "said": listener.texts, "files": files}


def _align(field: dict[str, FloatArray], survey: xr.Dataset) -> xr.Dataset:
    """Return the received field with the true total field, interpolated at its times.

    ``flagged`` is True where any flag but NO_BORESIGHT is set, which does not concern the total field.
    """
    times = survey["time"].to_numpy()
    truth = np.interp(field["time"], times, survey["truth_total_field"].to_numpy())
    flagged = (field["quality"].astype(int) & ~int(Quality.NO_BORESIGHT)) != 0
    columns = {**field, "truth": truth, "flagged": flagged}
    return xr.Dataset({name: ("time", column) for name, column in columns.items()})


def _compare(survey: xr.Dataset, nominal: Fit, received: xr.Dataset) -> dict[str, Any]:
    truth = survey["truth_total_field"].to_numpy()
    raw = np.linalg.norm(channels(survey), axis=1)
    error = (received["total_field"] - received["truth"]).to_numpy()
    good = ~received["flagged"].to_numpy()
    return {
        "samples": received.sizes["time"],
        "raw_rms_nT": rms(raw - truth),
        "nominal_rms_nT": rms(corrected(survey, nominal.calibration).total - truth),
        "corrected_rms_nT": rms(error),
        "unflagged_rms_nT": rms(error[good]),
        "unflagged_sigma_nT": rms(received["sigma"].to_numpy()[good]),
        "flagged": int((~good).sum()),
    }


def summary(result: dict[str, Any]) -> str:
    """Return the demonstration's result as text."""
    rows = [
        ("raw, as the fluxgate reads it", result["raw_rms_nT"]),
        ("one ellipsoid for all positions (nominal)", result["nominal_rms_nT"]),
        ("magbridge, as received over MAVLink", result["corrected_rms_nT"]),
        (f"  without the {result['flagged']} samples it flags", result["unflagged_rms_nT"]),
        ("  the 1-sigma it claims for those", result["unflagged_sigma_nT"]),
    ]
    table = [f"  {name:44}{value:10.2f} nT" for name, value in rows]
    header = f"\nerror of the total field over the survey, RMS of {result['samples']} samples:"
    return "\n".join([header, *table, "", "  " + "\n  ".join(result["files"])])
