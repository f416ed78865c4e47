"""Hide effects in third-party logs; measure the names that ``diagnose`` gives and the gain that it predicts.

    python tools/hidden_effects.py --data DIR [--snr 12] [--out FILE.parquet]

Each vehicle is calibrated on the first part of its log. An effect is added to the rest. ``diagnose`` gets the
first half of the rest; the second half is the later part. The size of an effect is its signal-to-noise
ratio: its norm, whitened by the noise of the untouched log, with the calibration projected out. The log keeps
the vehicle's own unexplained effects. "Promised" is the held-out ratio of RMS errors that ``diagnose``
reports; "real" is this ratio on the later part, which no fit has used. Sigma and error are those of the
extended calibration on the later part.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import xarray as xr
from measured import VEHICLES, joined
from studies import DATA, Column, Row, Study, show
from study.names import judge

from magbridge import Calibration, diagnose, fit, observations
from magbridge.arrays import FloatArray
from magbridge.diagnose.improvement import corrected
from magbridge.diagnose.joint import Joint, fit_joint
from magbridge.diagnose.noise import autoregressive_order
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.survey import load_survey
from magbridge.estimation.residual import rms

TELEMETRY = {"sensor_temperature": "degC", "payload_current": "A"}
"""Simulated telemetry that is added to every log, with its unit."""
DELAYS_S = np.geomspace(0.1, 120.0, 40)
"""Clock offsets that are tried to obtain the requested size, s."""
EFFECTS = "temperature_offset", "current_field", "offset_step", "relay", "clock_offset"
FOREIGN = ("relay",)
"""Effects that no cause describes: any name is wrong."""


def with_telemetry(log: xr.Dataset, seed: int) -> xr.Dataset:
    """Return the log with a simulated temperature that warms up and varies, and a current that switches."""
    rng = np.random.default_rng([4, seed])
    time = log["time"].to_numpy() - float(log["time"][0])
    x = time / max(float(time[-1]), 1.0)
    warm = 12.0 + 9.0 * (1.0 - np.exp(-x / rng.uniform(0.1, 0.4)))
    warm = warm + 2.0 * np.sin(2.0 * np.pi * (rng.uniform(1.0, 3.0) * x + rng.uniform()))
    bounds = np.sort(rng.uniform(0.0, 1.0, 2 * rng.integers(8, 15)))
    current = 1.5 * (np.searchsorted(bounds, x) % 2) + 0.02 * rng.standard_normal(len(x))
    values = {"sensor_temperature": warm, "payload_current": current}
    added = {name: ("time", values[name], {"units": unit}) for name, unit in TELEMETRY.items()}
    return log.assign(added)


def shape_of(effect: str, log: xr.Dataset, rng: np.random.Generator) -> FloatArray:
    """Return the offset (n, 3) of an effect along a random axis, per unit of its amplitude."""
    x: FloatArray = np.linspace(0.0, 1.0, log.sizes["time"])
    axis = rng.normal(size=3)
    series: FloatArray
    if effect == "temperature_offset":
        series = log["sensor_temperature"].to_numpy().astype(np.float64) - 12.0
    elif effect == "current_field":
        series = log["payload_current"].to_numpy().astype(np.float64)
    elif effect == "offset_step":
        series = (x > rng.uniform(0.15, 0.35)).astype(np.float64)
    else:
        series = np.asarray(np.searchsorted(np.sort(rng.uniform(0.0, 1.0, 24)), x) % 2, np.float64)
    return np.outer(series, axis / np.linalg.norm(axis))


def delayed(log: xr.Dataset, names: tuple[str, ...], delay: float) -> xr.Dataset:
    """Return the log with the telemetry of the masses late by `delay`, s."""
    time, late = log["time"].to_numpy(), {}
    for name in names:
        known = log[name].interpolate_na("time").to_numpy()
        late[name] = ("time", np.interp(time - delay, time, known), log[name].attrs)
    return log.assign(late)


def shifted(log: xr.Dataset, offset: FloatArray) -> xr.Dataset:
    """Return the log with an offset (n, 3), nT, added to the readings in sensor axes."""
    axes = {
        f"mag_{axis}": ("time", log[f"mag_{axis}"].to_numpy() + offset[:, k], log[f"mag_{axis}"].attrs)
        for k, axis in enumerate("xyz")
    }
    return log.assign(axes)


def signal_to_noise(problem: Problem, null: Joint, change: FloatArray) -> float:
    """Return the whitened norm of a change (n,) of the residual, nT, with the calibration projected out."""
    noise = null.noise
    A = noise.filter(problem.calibration_rows(slice(None)))
    y = noise.whiten(change)
    P = A.T @ A + np.diag(null.prior[: A.shape[1]])
    b = A.T @ y
    power = float(y @ y - b @ np.linalg.solve(P, b))
    return float(np.sqrt(max(power, 0.0)))


def residual_of(log: xr.Dataset, calibration: Calibration) -> Problem:
    """Return the diagnosis problem of a log and a calibration, which holds the residual."""
    return pose(load_survey([log], calibration), calibration)


def hide(
    effect: str,
    log: xr.Dataset,
    first: slice,
    calibration: Calibration,
    names: tuple[str, ...],
    snr: float,
    seed: int,
) -> tuple[xr.Dataset, float] | None:
    """Return the log with an effect of size `snr` in its part `first`, and the size; None if impossible."""
    rng = np.random.default_rng([7, seed])
    clean = residual_of(log.isel(time=first), calibration)
    rough = fit_joint(clean, [], 1, rounds=2)
    null = fit_joint(clean, [], autoregressive_order(rough.residual, clean.survey.slots))

    def size(changed: xr.Dataset) -> float:
        other = residual_of(changed.isel(time=first), calibration)
        both = np.isin(clean.survey.time, other.survey.time)
        change = np.zeros(len(clean))
        change[both] = other.residual[np.isin(other.survey.time, clean.survey.time)] - clean.residual[both]
        return signal_to_noise(clean, null, change)

    if effect == "clock_offset":
        if not names:
            return None
        tried = [(size(delayed(log, names, delay)), delay) for delay in DELAYS_S]
        found, delay = min(tried, key=lambda one: abs(one[0] - snr))
        return (delayed(log, names, delay), found) if found > 0.5 * snr else None
    offset = shape_of(effect, log, rng)
    scale = 10.0
    for _ in range(4):  # iterate, because the size is not exactly linear in the amplitude
        scale *= snr / size(shifted(log, scale * offset))
    changed = shifted(log, scale * offset)
    return changed, size(changed)


def run(seed: int, log: str, effect: str, snr: float, data: Path) -> list[Row]:
    """Hide one effect in one vehicle's log and diagnose it; return the row, or none if impossible."""
    warnings.simplefilter("ignore")
    known = VEHICLES[log](data)
    calibration = fit(observations(joined(known.known), known.parameters)).calibration
    rest = with_telemetry(joined(known.asked), seed)
    half = rest.sizes["time"] // 2
    hidden = hide(effect, rest, slice(0, half), calibration, known.parameters, snr, seed)
    if hidden is None:
        return []
    changed, size = hidden
    found, use = diagnose([changed.isel(time=slice(0, half))], calibration)
    judged = judge(found, [effect])
    first = judged.pop("first")
    row: Row = {key: float(value) for key, value in judged.items() if isinstance(value, bool)}
    row |= {"named": ", ".join(first) or "none", "right": float(first[:1] == [effect])}
    later = load_survey([changed.isel(time=slice(half, None))], found.calibration)
    given, written = (corrected(later, one) for one in (calibration, found.calibration))
    before, after = (rms(one.total - later.reference) for one in (given, written))
    return [
        row | {
            "size": size, "use": use.fit_for_use, "reason": use.reason, "promised": found.improvement.ratio,
            "real": after / before, "sigma": float(np.median(written.sigma)), "error": after,
        }
    ]  # fmt: skip


STUDY = Study(
    run, ("log", "effect", "named", "use"),
    {
        "S/N": Column("size", form=".1f"), "right": Column("right", form=".0f"),
        "in set": Column("in_set", form=".0f"),
        "promised": Column("promised"), "real": Column("real"), "sigma, nT": Column("sigma", form=".0f"),
        "error, nT": Column("error", form=".0f"),
    },
)  # fmt: skip


COUNTS = {
    "found": "found", "right first": "right", "in the set": "in_set", "alone": "alone",
    "a second name": "second", "a name": "a_name", "later part worse by more than 2 %": "worse",
}  # fmt: skip
SUMMARY = Study(run, ("foreign",), {name: Column(source, np.sum, ".0f") for name, source in COUNTS.items()})


if __name__ == "__main__":
    logs, effects = list(VEHICLES), list(EFFECTS)
    rows = STUDY.main(__doc__, seeds=1, first=0, logs=logs, effects=effects, snr=12.0, data=DATA)
    judged = {"foreign": rows["effect"].isin(FOREIGN), "a_name": rows["named"] != "none"}
    show(SUMMARY.table("Number of cases", rows.assign(**judged, worse=rows["real"] > 1.02)))
