"""Test ``diagnose`` in a second world: another glider, mission and noise, without the code of ``sitl``.

    python tools/second_world.py --cases 40

The forward model has dipoles with an induced part, eddy currents of a plate with a time constant, and
currents in a loop. The detector was not tuned on it. A diagnosis is *right* if it names the hidden cause,
*alone* if it names nothing else; *a second* is any further name. *Foreign* effects are not in the table of
causes, so any name for them is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from studies import Column, Row, Study, show
from study.ideal import cause_names

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.run import diagnose

STEP, HOURS, EPOCH = 5.0, 4.0, 1.75e9
EARTH = np.array([17_000.0, -4_600.0, 46_500.0])
"""Main field, nT: north, east, down."""
UNITS = {
    "mag_x": "nT", "mag_y": "nT", "mag_z": "nT", "reference_field": "nT", "roll": "deg", "pitch": "deg",
    "heading": "deg", "latitude": "deg", "longitude": "deg", "depth": "m", "battpos": "mm", "vbd": "cc",
    "sensor_temperature": "degC", "motor_current": "A", "fin": "deg",
}  # fmt: skip


@dataclass(frozen=True)
class Log:
    """Telemetry columns of a log, (n,) each, and the true field in body axes (n, 3), nT."""

    columns: dict[str, FloatArray]
    body: FloatArray


def rotated(columns: dict[str, FloatArray], field: FloatArray) -> FloatArray:
    """Rotate a field (n, 3) from north-east-down to body axes, by heading, pitch and roll."""
    roll, pitch, heading = (np.radians(columns[name]) for name in ("roll", "pitch", "heading"))
    n, e, d = field.T
    x, y = np.cos(heading) * n + np.sin(heading) * e, np.cos(heading) * e - np.sin(heading) * n
    x, d = np.cos(pitch) * x - np.sin(pitch) * d, np.sin(pitch) * x + np.cos(pitch) * d
    return np.stack([x, np.cos(roll) * y + np.sin(roll) * d, np.cos(roll) * d - np.sin(roll) * y], axis=1)


def logged(rng: np.random.Generator, hours: float, *, spins: bool) -> Log:
    """Simulate saw-tooth dives around a triangle; or with `spins`, rotations in place with moving masses."""
    n = int(hours * 3600.0 / STEP)
    t = STEP * np.arange(n)
    swayed = sum(
        rng.normal(0.0, 0.8) * np.sin(2.0 * np.pi * t / period + rng.uniform(0.0, 6.3))
        for period in rng.uniform(23.0, 70.0, 5)
    )
    period = rng.uniform(700.0, 1100.0)
    cycle = (t / period) % 1.0
    depth = 5.0 + 90.0 * (1.0 - np.abs(2.0 * cycle - 1.0))
    down = np.where(cycle < 0.5, 1.0, -1.0)
    down = np.convolve(np.pad(down, 6, mode="edge"), np.ones(13) / 13.0, mode="valid")
    if spins:
        heading, pitch = 2.3 * t % 360.0, 28.0 * np.sin(2.0 * np.pi * t / 1310.0)
        roll = 35.0 * np.sin(2.0 * np.pi * t / 410.0)
        batt, vbd = (
            14.0 * np.sign(np.sin(2 * np.pi * t / 2600.0)) * (t // 900 % 3) / 2,
            250.0 * (t // 700 % 3 - 1),
        )
        north = east = np.zeros(n)
    else:
        leg = np.floor(6.0 * t / t[-1] * 0.9999)
        heading = 120.0 * leg + 17.0 + swayed
        pitch, roll = -24.0 * down + 0.7 * swayed, 3.0 * np.sin(2.0 * np.pi * t / 330.0) + 0.5 * swayed
        batt, vbd = 9.0 * down + 2.0 * np.sin(leg), -200.0 * down
        north, east = (0.35 * STEP * np.cumsum(turn(np.radians(heading))) for turn in (np.cos, np.sin))
    warm = 12.0 - 7.0 / (1.0 + np.exp((40.0 - depth) / 8.0)) + 0.4 * np.sin(2.0 * np.pi * t / 9000.0)
    pump = (np.abs(np.diff(vbd, prepend=vbd[0])) > 1.0) * 1.7 + 0.02 * rng.random(n)
    columns = {
        "time": EPOCH + t + (0.0 if spins else 90_000.0), "roll": roll, "pitch": pitch,
        "heading": heading % 360.0,
        "latitude": 61.0 + north / 111_200.0, "longitude": 4.0 + east / 53_900.0, "depth": depth,
        "battpos": batt, "vbd": vbd, "sensor_temperature": warm, "motor_current": pump,
        "fin": 6.0 * np.sin(t / 30.0 + rng.uniform(0.0, 6.0)) + 4.0 * np.sign(np.sin(t / 1700.0)),
    }  # fmt: skip
    rock = sum(
        25.0
        * np.cos((north * np.cos(a) + east * np.sin(a)) / length + phase)
        * np.exp(depth / (9.0 * length))
        for a, length, phase in zip(
            rng.uniform(0, 6.3, 4), rng.uniform(150.0, 600.0, 4), rng.uniform(0, 6.3, 4), strict=True
        )
    )
    field = EARTH * (1.0 + rock / np.linalg.norm(EARTH))[:, None]
    columns["reference_field"] = np.linalg.norm(field, axis=1)
    return Log(columns, rotated(columns, field))


def dipole(r: FloatArray, m: FloatArray) -> FloatArray:
    """Return the field (n, 3), nT, of dipoles m (n, 3), A m², at displacements r (n, 3), m, from them."""
    far = np.linalg.norm(r, axis=1)[:, None]
    return np.asarray(100.0 * (3.0 * r * np.sum(r * m, axis=1)[:, None] / far**5 - m / far**3))


class Glider:
    """Magnetic model of a glider: hard iron, soft iron, and two masses with permanent and induced dipoles."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.soft = 0.01 * rng.normal(size=(3, 3))
        self.hard = rng.normal(0.0, 150.0, 3)
        self.at = [np.array([-0.8, 0.02, 0.1]), np.array([-1.1, 0.0, -0.05])]
        self.m = [rng.normal(0.0, 0.25, 3), rng.normal(0.0, 0.4, 3)]
        self.chi = [2e-6, 1e-6]

    def reads(self, log: Log) -> FloatArray:
        """Return the readings (n, 3), nT, without noise and without a hidden effect."""
        H = log.body + log.body @ self.soft.T + self.hard
        for at, m, chi, name, scale in zip(
            self.at, self.m, self.chi, ("battpos", "vbd"), (1e-3, 1e-4), strict=True
        ):
            r = -(at + np.outer(scale * log.columns[name], [1.0, 0.0, 0.0]))
            H = H + dipole(r, m + chi * log.body)
        return H


Effect = Callable[[Log, np.random.Generator], FloatArray]


def _lagged(x: FloatArray, lag: float) -> FloatArray:
    y = x.copy()
    for k in range(1, len(x)):
        y[k] = y[k - 1] + (x[k] - y[k - 1]) * STEP / (lag + STEP)
    return y


def _along(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    axis = rng.normal(size=3)
    return np.outer(x - x[0], axis / np.linalg.norm(axis))


def _plate(log: Log, rng: np.random.Generator) -> FloatArray:
    rate = np.gradient(log.body, STEP, axis=0)
    K = rng.normal(size=(3, 3))
    np.fill_diagonal(K, 0.0)
    return np.stack([_lagged(x, 2.0) for x in (rate @ K.T).T], axis=1)


def _hours(log: Log) -> FloatArray:
    return np.asarray((log.columns["time"] - log.columns["time"][0]) / 3600.0)


def _onset(log: Log, rng: np.random.Generator) -> FloatArray:
    return (_hours(log) > rng.uniform(0.8, 3.2)).astype(float)


def _telegraph(log: Log, rng: np.random.Generator, minutes: float) -> FloatArray:
    flips = rng.random(len(log.body)) < STEP / 60.0 / minutes
    return (np.cumsum(flips) % 2).astype(float)


def _chart(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return an error of the reference (n,), nT: a regional gradient and two bumps."""
    north, east = 111_200.0 * (log.columns["latitude"] - 61.0), 53_900.0 * (log.columns["longitude"] - 4.0)
    found = (north * rng.normal() + east * rng.normal()) / np.std(np.hypot(north, east))
    for _ in range(2):
        k = rng.integers(len(north))
        found = found + rng.normal() * np.exp(
            -((north - north[k]) ** 2 + (east - east[k]) ** 2) / 2.0 / 250.0**2
        )
    return found


def _fin(log: Log, rng: np.random.Generator) -> FloatArray:
    angle = np.radians(log.columns["fin"] + 20.0)
    r = np.stack([np.full_like(angle, 0.5), 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)
    return dipole(r, np.tile(rng.normal(size=3), (len(angle), 1)))


def _bolt(log: Log, rng: np.random.Generator) -> FloatArray:
    return _along(np.sign(log.columns["pitch"] + 3.0), rng) * (0.3 + _onset(log, rng))[:, None]


OWN: dict[str, Effect] = {
    "temperature_offset": lambda log, rng: _along(_lagged(log.columns["sensor_temperature"], 600.0), rng),
    "current_field": lambda log, rng: _along(log.columns["motor_current"], rng),
    "offset_step": lambda log, rng: _along(_onset(log, rng), rng),
    "offset_drift": lambda log, rng: _along(_hours(log) + 0.06 * _hours(log) ** 2, rng),
    "pressure_offset": lambda log, rng: _along(log.columns["depth"], rng),
    "eddy_current": _plate,
    "unmodelled_actuator": _fin,
    "interference_tone": lambda log, rng: _along(np.sin(log.columns["time"] / rng.uniform(2.1, 14.0)), rng),
    "map_error": _chart,
    "diurnal_variation": lambda log, rng: np.cos(2 * np.pi * (_hours(log) - rng.uniform(0.0, 24.0)) / 24.0),
}  # fmt: skip
"""Effects by their cause: each returns an offset (n, 3), or an error of the reference (n,)."""
FOREIGN: dict[str, Effect] = {
    "relay": lambda log, rng: _along(_telegraph(log, rng, 20.0), rng),
    "connector": lambda log, rng: _along(_telegraph(log, rng, 2.0) * _onset(log, rng), rng),
    "ship": lambda log, rng: _along((1.0 + ((_hours(log) - rng.uniform(1, 3)) / 0.1) ** 2) ** -1.5, rng),
    "loose bolt": _bolt,
    "bursts": lambda log, rng: _along(_telegraph(log, rng, 15.0) * np.sin(log.columns["time"] / 11.0), rng),
}  # fmt: skip
"""Foreign effects by name: none is a cause of the table."""


def dataset(log: Log, H: FloatArray, reference: FloatArray | float = 0.0) -> xr.Dataset:
    columns = log.columns | dict(zip(("mag_x", "mag_y", "mag_z"), H.T, strict=True))
    columns["reference_field"] = columns["reference_field"] + reference
    ds = xr.Dataset({k: ("time", v) for k, v in columns.items() if k != "time"}, {"time": columns["time"]})
    for name, unit in UNITS.items():
        ds[name].attrs["units"] = unit
    return ds.assign_attrs(source="second world")


def case(number: int, name: str, snr: float) -> list[Row]:
    """Calibrate a glider, hide one effect in its survey, diagnose the survey, and return the row."""
    rng = np.random.default_rng([20_251, number])
    glider, spins, survey = Glider(rng), logged(rng, 1.0, spins=True), logged(rng, HOURS, spins=False)

    def noise(n: int) -> FloatArray:
        e = rng.standard_t(6.0, (n, 3)) * 0.8
        return e + 0.6 * np.vstack([np.zeros(3), e[:-1]])  # a moving average, unlike the simulator's noise

    clean = glider.reads(spins)
    calibration = fit(
        observations(dataset(spins, clean + noise(len(clean))), ["battpos", "vbd"]), "auto"
    ).calibration
    effect = (OWN | FOREIGN)[name](survey, rng)
    unit = survey.body / np.linalg.norm(survey.body, axis=1)[:, None]
    seen = effect if effect.ndim == 1 else np.sum(effect * unit, axis=1)
    effect = effect * snr / (np.std(seen) * np.sqrt(len(seen)))
    H = glider.reads(survey) + noise(len(seen)) + (effect if effect.ndim == 2 else 0.0)
    log = dataset(survey, H, effect if effect.ndim == 1 else 0.0)
    return reported(name, diagnose([log], calibration).diagnosis, OWN)


def reported(name: str, found: Diagnosis, own: Container[str]) -> list[Row]:
    """Return the row of a case; `own` holds the effects that are causes of the table."""
    named = cause_names(one.candidate.cause for one in found.findings)
    named |= {"outliers"} if found.wrong is not None else set()
    sets = named | cause_names(r.candidate.cause for one in found.findings for r in one.competing)
    truth = cause_names([name])
    row: Row = {"kind": "foreign" if name else "nothing", "hidden": name, "named": ", ".join(sorted(named))}
    row["name"] = float(bool(named))
    if name in own:
        row |= {
            "kind": "cause", "right": float(truth <= named), "in_set": float(truth <= sets),
            "alone": float(sets == truth), "second": float(len(named) > 1),
        }  # fmt: skip
    return [row]


HEADINGS = {
    "a name": "name", "right": "right", "in the set": "in_set", "alone": "alone", "a second": "second",
}  # fmt: skip


def study(run: Callable[..., list[Row]], names: Sequence[str], doc: str | None) -> None:
    """Run cases, each of which hides one of `names` (none if empty), and print the counts of the names."""

    def cases_of(options: argparse.Namespace) -> list[tuple[int, str, float]]:
        numbers = range(options.first, options.first + options.cases)
        return [(number, names[number % len(names)], options.snr) for number in numbers]

    columns = {heading: Column(source, np.mean, ".0%") for heading, source in HEADINGS.items()}
    rows = Study(run, ("kind",), columns).main(doc, cases_of, cases=2 * len(names), first=0, snr=25.0)
    show(rows[["hidden", "named"]].to_string())


if __name__ == "__main__":
    study(case, (*OWN, *FOREIGN), __doc__)
