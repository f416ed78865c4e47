"""Test ``diagnose`` in other simulated worlds, whose physics differ from ``sitl`` and from the detector.

    python tools/other_worlds.py --worlds dipoles bars --cases 28

The masses are dipoles or bars with two poles; the noise is a moving average or flicker noise. The effects
follow laws that the detector does not have: Bouc and Wen's hysteresis, a plate's eddy currents with a time
constant, a damped filter of second order, a soft clip. The detector was not tuned on them. Case after case
hides another effect; the last one of a cycle hides nothing. Any name for a foreign effect is wrong.
:mod:`study.names` explains the columns of the table.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from independent import (
    METRES_PER_DEGREE,
    STEP_S,
    Crust,
    Dipoles,
    Log,
    Vehicle,
    along,
    dipole_field,
    logged,
    rotated,
)
from scipy.signal import bessel, lfilter, sosfilt
from studies import Column, Row, Study, show
from study.names import judge

from magbridge import diagnose
from magbridge.arrays import FloatArray

HOURS = 4.0
"""Length of a survey, h."""
POLES = 20.0
"""1-sigma of the strength of a mass' pole, nT m²."""


class Bars(Vehicle):
    """Vehicle whose masses are bars with two poles each, ``H = m r / |r|^3``, drawn from `seed`."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 4])
        self.soft, self.hard = 0.015 * rng.normal(size=(3, 3)), rng.normal(0.0, 200.0, 3)
        self._bars = {}
        for name, at in {"battpos": (-0.7, 0.05, 0.08), "ballast": (-1.0, -0.04, 0.0)}.items():
            self._bars[name] = np.array(at), rng.normal(0.0, 0.12, 3), 10.0 * POLES * rng.normal()

    def mass_field(self, name: str, travel: FloatArray, body: FloatArray) -> FloatArray:
        """Return the field of a bar's two poles."""
        at, bar, pole = self._bars[name]
        field = np.zeros_like(body)
        for end, sign in ((bar, 1.0), (-bar, -1.0)):
            r = -(at + end + np.outer(travel, [1.0, 0.0, 0.0]))
            field += sign * pole * r / np.linalg.norm(r, axis=1)[:, None] ** 3
        return field


WORLDS: dict[str, tuple[Callable[[int], Vehicle], Callable[[np.ndarray], np.ndarray]]] = {
    "dipoles": (Dipoles, lambda f: np.abs(1.0 + 0.6 * np.exp(-2j * np.pi * f))),
    "bars": (Bars, lambda f: np.sqrt(1.0 + 0.1 / np.maximum(f, f[1]))),
}
"""Vehicles of each world, and the amplitude of its noise (k,) at frequencies (k,) over the sample rate."""


def coloured(white: FloatArray, amplitude: np.ndarray) -> FloatArray:
    """Return a series (n, ...) whose spectrum is multiplied by an amplitude (n // 2 + 1,)."""
    spectrum = np.fft.rfft(white, axis=0)
    return np.asarray(np.fft.irfft((spectrum.T * amplitude).T, len(white), axis=0))


# ---- the effects -------------------------------------------------------------------------------------------


Effect = Callable[[Vehicle, Log, np.random.Generator], FloatArray]
"""Function that returns an offset (n, 3), or an error of the reference (n,), in arbitrary units."""


def _lagged(x: FloatArray, lag: float) -> FloatArray:
    """Return the change of x (n, ...) after a first-order lag, s."""
    gain = STEP_S / (lag + STEP_S)
    return np.asarray(lfilter([gain], [1.0, gain - 1.0], x - x[0], axis=0))


def _soaked(log: Log, lag: float) -> FloatArray:
    """Return the temperature change of the electronics (n,), degC: the water's with a first-order lag."""
    return _lagged(log.columns["sensor_temperature"], lag)


def _bouc_wen(log: Log) -> FloatArray:
    """Return the hysteresis (n,) ``dz = dx - (0.6 |dx| z + 0.4 dx |z|)`` of a tray."""
    dx = np.diff(log.columns["battpos"], prepend=log.columns["battpos"][0]) / 0.4
    z = np.zeros(len(dx))
    for k in range(1, len(z)):
        z[k] = z[k - 1] + dx[k] - 0.6 * abs(dx[k]) * z[k - 1] - 0.4 * dx[k] * abs(z[k - 1])
    return z


def _filtered(H: FloatArray) -> FloatArray:
    """Return the change of H (n, 3) by a Bessel filter of second order, 0.02 Hz."""
    sections = bessel(2, 0.02, fs=1.0 / STEP_S, output="sos")
    return np.asarray(sosfilt(sections, H - H[0], axis=0) + H[0] - H)


def _shifted(log: Log, H: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the change of H (n, 3) if each axis is delayed by a random time of 0 to 2 s."""
    late = zip(rng.uniform(0.0, 2.0, 3), H.T, strict=True)
    return np.stack([np.interp(log.time - d, log.time, x) - x for d, x in late], axis=1)


def _plate(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the eddy currents (n, 3) of a plate with a time constant of 2 s."""
    K = rng.normal(size=(3, 3))
    np.fill_diagonal(K, 0.0)
    return _lagged(np.gradient(log.body, STEP_S, axis=0) @ K.T, 2.0)


def _chart(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return an error of the reference (n,), nT: a regional gradient and two bumps."""
    latitude, longitude = log.columns["latitude"], log.columns["longitude"]
    north = METRES_PER_DEGREE * (latitude - latitude[0])
    east = METRES_PER_DEGREE * np.cos(np.radians(latitude)) * (longitude - longitude[0])
    found = (north * rng.normal() + east * rng.normal()) / np.std(np.hypot(north, east))
    for k in rng.integers(len(north), size=2):
        far = np.hypot(north - north[k], east - east[k])
        found = found + rng.normal() * np.exp(-0.5 * (far / 250.0) ** 2)
    return np.asarray(found)


def _fin(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the field (n, 3) of a magnet on a fin's lever."""
    angle = np.radians(log.columns["fin"] + 20.0)
    r = np.stack([np.full_like(angle, 0.5), 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)
    return dipole_field(r, np.tile(rng.normal(size=3), (len(angle), 1)))


def _step(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the offset (n,) after a shock, which relaxes partly."""
    since = log.hours - rng.uniform(0.8, 3.0)
    return (since > 0.0) * (0.6 + 0.4 * np.exp(-np.maximum(since, 0.0) / 0.2))


def _telegraph(log: Log, rng: np.random.Generator, minutes: float) -> FloatArray:
    """Return the state (n,) of a switch that flips at random, on average after some minutes."""
    return (np.cumsum(rng.random(len(log.body)) < STEP_S / 60.0 / minutes) % 2).astype(float)


def _pendulum(log: Log) -> FloatArray:
    """Return the angle (n,) of a cable that swings, with a period of 40 s, when the vehicle turns."""
    rate = np.gradient(np.unwrap(np.radians(log.columns["heading"])))
    x, v, found = 0.0, 0.0, np.zeros(len(rate))
    for k, push in enumerate(rate):
        v += STEP_S * (-((2.0 * np.pi / 40.0) ** 2) * x - 0.02 * v + push)
        x += STEP_S * v
        found[k] = x
    return found


def _strokes(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the magnetisation (n,) of a frame by shocks, which decays within minutes after each shock."""
    since = log.hours[:, None] - rng.uniform(0.2, 3.6, 7)
    fading = np.exp(-np.maximum(since, 0.0) / 0.05) * (since > 0.0)
    return np.asarray(fading @ rng.normal(size=7))


def _escort(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the field (n, 3) of a vessel that circles, a dipole, along the vehicle's own axes."""
    turn = 2.0 * np.pi * np.cumsum(1.0 + 0.3 * np.sin(log.hours * 5.0)) * STEP_S / 1500.0
    r = np.stack([90.0 * np.cos(turn) + 60.0, 70.0 * np.sin(turn), np.full_like(turn, -60.0)], axis=1)
    return rotated(log.columns, dipole_field(r, np.tile(rng.normal(size=3), (len(r), 1))))


def _heater(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the state (n,) of an unlogged heater: on in 30 % of a cycle whose period grows."""
    cycle = np.cumsum(1.0 / (300.0 + 400.0 * log.hours / HOURS)) * STEP_S
    return ((cycle + rng.random()) % 1.0 < 0.3).astype(float)


def _bolt(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the field (n, 3) of a bolt that tips over with the pitch, and becomes stronger by a shock."""
    return along(np.sign(log.columns["pitch"] + 3.0), rng) * (0.3 + (_step(log, rng) > 0.0))[:, None]


OWN: dict[str, Effect] = {
    "temperature_offset": lambda _v, log, rng: along((x := _soaked(log, 900.0)) + 0.01 * x * x, rng),
    "temperature_scale": lambda v, log, rng: v.reads(log) * _soaked(log, 400.0)[:, None] * rng.normal(size=3),
    "hysteresis": lambda _v, log, rng: along(_bouc_wen(log), rng),
    "actuator_order": lambda _v, log, rng: along(np.cos(5.0 * log.columns["battpos"]), rng),
    "unmodelled_actuator": lambda _v, log, rng: _fin(log, rng),
    "clock_offset": lambda v, log, _rng: v.reads(log, later=-3.0) - v.reads(log),
    "filter_lag": lambda v, log, _rng: _filtered(v.reads(log)),
    "channel_skew": lambda v, log, rng: _shifted(log, v.reads(log), rng),
    "nonlinearity": lambda v, log, rng: (v.reads(log) / 3e4) ** 3 * rng.normal(size=3),
    "offset_step": lambda _v, log, rng: along(_step(log, rng), rng),
    "offset_drift": lambda _v, log, rng: along(log.hours + 0.06 * log.hours**2, rng),
    "current_field": lambda _v, log, rng: along(log.columns["motor_current"] ** 1.3, rng),
    "pressure_offset": lambda _v, log, rng: along(np.sqrt(log.columns["depth"]), rng),
    "eddy_current": lambda _v, log, rng: _plate(log, rng),
    "interference_tone": lambda _v, log, rng: along(np.sin(log.time / rng.uniform(2.1, 14.0)), rng),
    "map_error": lambda _v, log, rng: _chart(log, rng),
    "diurnal_variation": lambda _v, log, rng: np.cos(np.pi * (log.hours - rng.uniform(0.0, 24.0)) / 12.0),
}
"""Effects by their cause."""
FOREIGN: dict[str, Effect] = {
    "a relay": lambda _v, log, rng: along(_telegraph(log, rng, 20.0), rng),
    "a loose connector": lambda _v, log, rng: along(
        _telegraph(log, rng, 2.0) * (log.hours > rng.uniform(0.8, 3.2)), rng
    ),
    "a ship": lambda _v, log, rng: along((1.0 + ((log.hours - rng.uniform(1, 3)) / 0.1) ** 2) ** -1.5, rng),
    "a loose bolt": lambda _v, log, rng: _bolt(log, rng),
    "bursts": lambda _v, log, rng: along(_telegraph(log, rng, 15.0) * np.sin(log.time / 11.0), rng),
    "a cable that swings": lambda _v, log, rng: along(_pendulum(log), rng),
    "shocks that are forgotten": lambda _v, log, rng: along(_strokes(log, rng), rng),
    "a vessel that circles": lambda _v, log, rng: _escort(log, rng),
    "a heater": lambda _v, log, rng: along(_heater(log, rng), rng),
    "a thermocouple": lambda _v, log, rng: along(np.gradient(_soaked(log, 100.0)), rng),
}
"""Foreign effects by name: none is a cause of the table."""
NAMES = (*OWN, *FOREIGN, "")


# ---- the study ---------------------------------------------------------------------------------------------


def run(world: str, case: int, snr: float) -> list[Row]:
    """Calibrate a glider, hide one effect in its survey, diagnose the survey, and return the row."""
    name, rng = NAMES[case % len(NAMES)], np.random.default_rng([20_262, case])
    draw, colour = WORLDS[world]
    vehicle, survey = draw(case), logged(case, HOURS, spirals=False, crust=Crust(case, 25.0, 900.0))

    def noise(n: int) -> FloatArray:
        """Return noise (n, 3) of 1 nT RMS."""
        made = coloured(rng.standard_t(6.0, (n, 3)), colour(np.fft.rfftfreq(n)))
        return np.asarray(made / made.std())

    ballast, n = survey.columns["ballast"], len(survey.time)
    survey.columns.update(
        reference_field=np.linalg.norm(survey.body, axis=1),
        motor_current=0.6 * (np.abs(np.gradient(ballast)) > 0.01) + 0.02 * rng.random(n),
        fin=8.0 * np.sin(2.0 * np.pi * survey.hours * 11.6 + rng.uniform(0.0, 6.0)),
    )
    calibration = vehicle.calibrated(case, noise)
    H, reference = vehicle.reads(survey) + noise(n), np.zeros(n)
    if name:
        effect = (OWN | FOREIGN)[name](vehicle, survey, rng)
        seen = effect if effect.ndim == 1 else survey.visible(effect)
        amplitude = colour(np.fft.rfftfreq(n))
        power = np.mean(np.square(amplitude))
        effect = effect * snr / (np.linalg.norm(coloured(seen - seen.mean(), 1.0 / amplitude)) * power**0.5)
        H, reference = (H, effect) if effect.ndim == 1 else (H + effect, reference)
    judged = judge(diagnose([survey.dataset(H, reference)], calibration).diagnosis, [name] * bool(name))
    row: Row = {"hidden": name, "named": ", ".join(judged["named"]), "name": float(bool(judged["named"]))}
    if name in OWN:
        known = {key: float(judged[key]) for key in ("found", "right", "in_set", "alone", "second")}
        return [row | known | {"kind": "cause"}]
    return [row | {"kind": "foreign" if name else "nothing", "found": float(judged["found"])}]


SOURCES = {
    "found": "found", "a name": "name", "right": "right", "in the set": "in_set", "alone": "alone",
    "a second": "second",
}  # fmt: skip
COLUMNS = {heading: Column(name, np.mean, ".0%") for heading, name in SOURCES.items()}
STUDY = Study(run, ("world", "kind"), COLUMNS)


if __name__ == "__main__":
    rows = STUDY.main(__doc__, worlds=list(WORLDS), cases=len(NAMES), first=0, snr=25.0)
    show(rows[["world", "hidden", "named"]].to_string())
