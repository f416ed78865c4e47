"""Test ``diagnose`` in a third simulation, whose physics differ from ``sitl`` and from the second world.

    python tools/third_world.py --cases 22

The mission is a lawn-mower pattern of dives near the equator. Masses are bars with two poles, the noise is
flicker noise, and the effects follow laws that neither the detector nor the other simulations have (Bouc and
Wen's hysteresis, a damped filter of second order, a soft clip). The detector was not tuned on it.
:mod:`independent` explains the table; in a log without a hidden effect, any name is false.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from independent import Log, along, calibrated, diagnosed, main, rotated
from scipy.signal import bessel, sosfilt
from studies import Row

from magbridge.arrays import FloatArray

STEP, HOURS, EPOCH = 5.0, 4.0, 1.76e9
EARTH = np.array([27_500.0, 1_900.0, -18_200.0])
"""Main field, nT: north, east, down."""
POLES = 20.0
"""1-sigma of the strength of a mass' pole, nT m²."""


def logged(rng: np.random.Generator, hours: float, *, spins: bool) -> Log:
    """Simulate dives on a lawn-mower track; or with `spins`, rotations in place with moving masses."""
    n = int(hours * 3600.0 / STEP)
    t = STEP * np.arange(n)
    wave = np.sin(2.0 * np.pi * t / rng.uniform(500.0, 800.0))
    sway = np.convolve(rng.normal(size=n + 8), np.hanning(9), "valid")
    if spins:
        heading, pitch = 3.1 * t % 360.0, 25.0 * np.sin(2.0 * np.pi * t / 940.0)
        roll, north, east = 40.0 * np.sin(2.0 * np.pi * t / 370.0), np.zeros(n), np.zeros(n)
        batt, vbd = 15.0 * np.sin(2.0 * np.pi * t / 1900.0), 300.0 * np.sin(2.0 * np.pi * t / 2700.0)
    else:
        leg = np.floor(16.0 * t / t[-1] * 0.9999)
        across = leg < 8
        heading = np.where(leg % 2 == 0, 12.0, 192.0) + 90.0 * ~across + 2.0 * sway
        pitch, roll = 22.0 * wave + sway, 8.0 * np.sin(2.0 * np.pi * t / 900.0) + 1.5 * sway
        batt, vbd = 12.0 * wave + 2.0 * np.cos(leg), -250.0 * np.tanh(3.0 * wave)
        north, east = (0.4 * STEP * np.cumsum(f(np.radians(heading))) for f in (np.cos, np.sin))
    depth = 40.0 + 35.0 * np.cos(2.0 * np.pi * t / 650.0)
    warm = 24.0 - 9.0 * np.clip((depth - 25.0) / 30.0, 0.0, 1.0) + 0.8 * t / t[-1]
    columns = {
        "time": EPOCH + t + (0.0 if spins else 50_000.0), "roll": roll, "pitch": pitch,
        "heading": heading % 360.0,
        "latitude": -4.0 + north / 110_600.0, "longitude": 39.0 + east / 111_100.0,
        "depth": depth, "battpos": batt, "vbd": vbd, "sensor_temperature": warm,
        "motor_current": 0.6 * (np.abs(np.gradient(vbd)) > 10.0) + 0.02 * rng.random(n),
        "fin": 8.0 * np.sin(2.0 * np.pi * t / 310.0 + rng.uniform(0.0, 6.0)),
    }  # fmt: skip
    columns["reference_field"] = np.full(n, float(np.linalg.norm(EARTH)))
    return Log(columns, rotated(columns, np.tile(EARTH, (n, 1))))


class Vehicle:
    """Magnetic model: hard and soft iron, and two masses as bars with two poles each: ``H = m r / |r|^3``."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.soft, self.hard = 0.015 * rng.normal(size=(3, 3)), rng.normal(0.0, 200.0, 3)
        self.pole = POLES * rng.normal(size=2)
        self.bar = rng.normal(0.0, 0.12, (2, 3))
        self.at = np.array([[-0.7, 0.05, 0.08], [-1.0, -0.04, 0.0]])

    def reads(self, log: Log, later: float = 0.0) -> FloatArray:
        """Return the noiseless readings (n, 3), nT, with the mass positions `later` s after each sample."""
        H = log.body + log.body @ self.soft.T + self.hard
        for at, pole, bar, name, scale in zip(
            self.at, self.pole, self.bar, ("battpos", "vbd"), (1e-3, 1e-4), strict=True
        ):
            x = scale * np.interp(log.time + later, log.time, log.columns[name])
            for end, sign in ((bar, 1.0), (-bar, -1.0)):
                r = -(at + end + np.outer(x, [1.0, 0.0, 0.0]))
                H = H + sign * pole * 10.0 * r / np.linalg.norm(r, axis=1)[:, None] ** 3
        return H


Effect = Callable[[Vehicle, Log, np.random.Generator], FloatArray]
"""Function that returns the field added to the reading (n, 3), in arbitrary units."""


def _bouc_wen(log: Log) -> FloatArray:
    """Return the hysteresis (n,) ``dz = dx - (0.6 |dx| z + 0.4 dx |z|)`` of a tray, x in units of 6 mm."""
    dx = np.diff(log.columns["battpos"], prepend=log.columns["battpos"][0]) / 6.0
    z = np.zeros(len(dx))
    for k in range(1, len(z)):
        z[k] = z[k - 1] + dx[k] - 0.6 * abs(dx[k]) * z[k - 1] - 0.4 * dx[k] * abs(z[k - 1])
    return z


def _filtered(H: FloatArray) -> FloatArray:
    """Return H (n, 3) after a Bessel filter of second order, 0.02 Hz."""
    sections = bessel(2, 0.02, fs=1.0 / STEP, output="sos")
    return np.asarray(sosfilt(sections, H - H[0], axis=0) + H[0])


def _shifted(log: Log, H: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return H (n, 3) with each axis delayed by a random time of 0 to 2 s."""
    t = log.time
    late = zip(rng.uniform(0.0, 2.0, 3), H.T, strict=True)
    return np.stack([np.interp(t - d, t, x) for d, x in late], axis=1)


def _soaked(log: Log, seconds: float) -> FloatArray:
    """Return the temperature change of the electronics (n,), degC: the water's with a first-order lag."""
    y = log.columns["sensor_temperature"].copy()
    for k in range(1, len(y)):
        y[k] += (y[k - 1] - y[k]) * np.exp(-STEP / seconds)
    return np.asarray(y - y[0])


def _pendulum(log: Log) -> FloatArray:
    """Return the angle (n,) of a cable that swings, with a period of 40 s, when the vehicle turns."""
    rate = np.gradient(np.unwrap(np.radians(log.columns["heading"])))
    x, v, found = 0.0, 0.0, np.zeros(len(rate))
    for k, push in enumerate(rate):
        v += STEP * (-((2.0 * np.pi / 40.0) ** 2) * x - 0.02 * v + push)
        x += STEP * v
        found[k] = x
    return found


def _strokes(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the magnetisation (n,) of a frame by shocks, which decays within minutes after each shock."""
    since = log.hours[:, None] - rng.uniform(0.2, 3.6, 7)
    fading = np.exp(-np.maximum(since, 0.0) / 0.05) * (since > 0.0)
    return np.asarray(fading @ rng.normal(size=7))


def _escort(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the field (n, 3) of a vessel that circles, a dipole, in body axes."""
    turn = 2.0 * np.pi * np.cumsum(1.0 + 0.3 * np.sin(log.hours * 5.0)) * STEP / 1500.0
    r = np.stack([90.0 * np.cos(turn) + 60.0, 70.0 * np.sin(turn), np.full_like(turn, -60.0)], axis=1)
    m = rng.normal(size=3)
    far = np.linalg.norm(r, axis=1)[:, None]
    return rotated(log.columns, 3.0 * r * (r @ m)[:, None] / far**5 - m / far**3)


def _heater(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the state (n,) of an unlogged heater: on in 30 % of a cycle whose period grows."""
    cycle = np.cumsum(1.0 / (300.0 + 400.0 * log.hours / HOURS)) * STEP
    return ((cycle + rng.random()) % 1.0 < 0.3).astype(float)


def _step(log: Log, rng: np.random.Generator) -> FloatArray:
    """Return the offset (n,) after a shock, which relaxes partly."""
    since = log.hours - rng.uniform(0.8, 3.0)
    return (since > 0.0) * (0.6 + 0.4 * np.exp(-np.maximum(since, 0.0) / 0.2))


OWN: dict[str, Effect] = {
    "temperature_offset": lambda _v, log, rng: along((x := _soaked(log, 900.0)) + 0.01 * x * x, rng),
    "temperature_scale": lambda v, log, rng: v.reads(log) * _soaked(log, 400.0)[:, None] * rng.normal(size=3),
    "hysteresis": lambda _v, log, rng: along(_bouc_wen(log), rng),
    "actuator_order": lambda _v, log, rng: along(np.cos(log.columns["battpos"] / 3.0), rng),
    "clock_offset": lambda v, log, _rng: v.reads(log, later=-3.0) - v.reads(log),
    "filter_lag": lambda v, log, _rng: _filtered(v.reads(log)) - v.reads(log),
    "channel_skew": lambda v, log, rng: _shifted(log, v.reads(log), rng) - v.reads(log),
    "nonlinearity": lambda v, log, rng: (v.reads(log) / 3e4) ** 3 * rng.normal(size=3),
    "offset_step": lambda _v, log, rng: along(_step(log, rng), rng),
    "current_field": lambda _v, log, rng: along(log.columns["motor_current"] ** 1.3, rng),
    "pressure_offset": lambda _v, log, rng: along(np.sqrt(log.columns["depth"]), rng),
}  # fmt: skip
"""Effects by their cause."""
FOREIGN: dict[str, Effect] = {
    "a cable that swings": lambda _v, log, rng: along(_pendulum(log), rng),
    "shocks that are forgotten": lambda _v, log, rng: along(_strokes(log, rng), rng),
    "a vessel that circles": lambda _v, log, rng: _escort(log, rng),
    "a heater": lambda _v, log, rng: along(_heater(log, rng), rng),
    "a thermocouple": lambda _v, log, rng: along(np.gradient(_soaked(log, 100.0)), rng),
}  # fmt: skip
"""Foreign effects by name: none is a cause of the table."""
EVERY = (*OWN, *FOREIGN, "", *FOREIGN)


def _colour(n: int) -> FloatArray:
    """Return the noise's amplitude by frequency: white, plus 1/f power below a tenth of the sample rate."""
    f = np.fft.rfftfreq(n)
    return np.asarray(np.sqrt(1.0 + 0.1 / np.maximum(f, 1.0 / n)))


def flicker(rng: np.random.Generator, n: int) -> FloatArray:
    """Return flicker noise (n, 3) of 1 nT RMS."""
    made = np.fft.irfft(np.fft.rfft(rng.normal(size=(n, 3)), axis=0) * _colour(n)[:, None], n, axis=0)
    return np.asarray(made / np.std(made))


def loudness(x: FloatArray) -> float:
    """Return the signal-to-noise ratio of x (n,), nT: the norm of x after a filter that whitens the noise."""
    n, colour = len(x), _colour(len(x))
    white = np.fft.irfft(np.fft.rfft(x - x.mean()) / colour, n)
    return float(np.linalg.norm(white) * np.sqrt(np.mean(colour**2)))


def run(case: int, snr: float) -> list[Row]:
    """Calibrate a vehicle, hide one effect in its survey, diagnose the survey, and return the row."""
    name, rng = EVERY[case % len(EVERY)], np.random.default_rng([20_262, case])
    vehicle, spins, survey = Vehicle(rng), logged(rng, 1.0, spins=True), logged(rng, HOURS, spins=False)
    calibration = calibrated(spins.dataset(vehicle.reads(spins) + flicker(rng, len(spins.body))))
    H = vehicle.reads(survey) + flicker(rng, len(survey.body))
    if name:
        effect = (OWN | FOREIGN)[name](vehicle, survey, rng)
        H = H + effect * snr / loudness(survey.visible(effect))
    return diagnosed(name, survey.dataset(H), calibration, OWN)


if __name__ == "__main__":
    main(run, 2 * len(EVERY), __doc__)
