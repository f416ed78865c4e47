"""Compensate a scalar magnetometer on simulated flights: fit each half and test the fit on the other half.

    python tools/scalar_flights.py [--flights 10] [--workers 2] [--out rows.parquet]

The simulation shares no code with the model. The vehicle has iron, currents, a relay, control surfaces and a
channel that moves in the second half only, for an hour at 10 Hz over a crustal field of 30 nT, with flicker
noise. The table has the RMS error of the tested half, next to Tolles-Lawson: least squares, ridge, and ridge
on band-passed data, and the first two with all telemetry channels. ``true priors`` is this fit with the
widths from which the simulation draws: no method that fits the same half can be better on average. ``same
half`` is this fit, tested on its own half. In the flights ``hidden``, an unlogged source of 3,000 nT is on
for 65 s of the second half.
"""

from __future__ import annotations

import argparse
from typing import Any

import msgspec
import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.spatial.transform import Rotation
from studies import Column, Study, percentile

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.scalar_fit import adapt_to_log, fit_scalar
from magbridge.calibration.scalar import (
    CYCLE_LEVEL_SIGMA_NT,
    ScalarSensor,
    ScalarSeries,
    compare_sensors,
    correct_scalar,
    scalar_design,
)
from magbridge.estimation.information import GaussianInformation

RATE_HZ, MINUTES = 10.0, 60
CHANNELS = "current", "relay", "aileron", "rudder", "temperature", "voltage", "heater", "late_current"
FIELD_PER_UNIT_NT = np.array([3.0, 5.0, 0.3, 0.5, 0.5, 1.0, 2.0, 1.0])
VECTOR_NOISE_NT = 1.0
BAND_HZ, RIDGE = (0.1, 0.9), 0.025
PERMANENT_NT, INDUCED_NT, EDDY_NT_S = 600.0, 60.0, 8.0
"""1-sigma of the entries of the simulated vehicle's permanent, induced, and eddy-current field."""
NO_LAG_S = 1e-3
"""1-sigma of the lag, s: the simulation has none."""
METHODS = (
    "this fit", "true priors", "least squares", "ridge", "band-passed ridge", "least squares, all",
    "ridge, all", "same half",
)  # fmt: skip


def flight(seed: int, hidden: bool) -> ScalarSeries:
    """Return a simulated flight with the true field as reference; `hidden` adds an unlogged source."""
    random = np.random.default_rng(seed)
    n = int(MINUTES * 60 * RATE_HZ)
    t = np.arange(n) / RATE_HZ

    def smooth(seconds: float) -> FloatArray:
        a = np.exp(-1.0 / (seconds * RATE_HZ))
        noise = random.normal(size=n + int(10 * seconds * RATE_HZ))
        series = lfilter([1.0], [1.0, -a], lfilter([1.0], [1.0, -a], noise))[-n:]
        return np.asarray((series - series.mean()) / series.std())

    headings = np.array([0, 90, 180, 270, 45, 135, 225, 315] * MINUTES, float)[(t // 180.0).astype(int)]
    turn = np.ones(int(20 * RATE_HZ)) / (20 * RATE_HZ)
    heading = np.convolve(np.pad(headings, (100, 99), "edge"), turn, "valid")
    box, swing = (t % 180 > 40) & (t % 180 < 85), np.sin(2 * np.pi * t / 5)
    roll = 2 * smooth(3) + smooth(20) + np.where(box & (t % 180 < 55), 10 * swing, 0.0)
    pitch = 1.5 * smooth(4) + smooth(30)
    pitch += np.where(box & (t % 180 >= 55) & (t % 180 < 70), 5 * swing, 0.0)
    heading = heading + 0.7 * smooth(5) + np.where(box & (t % 180 >= 70), 5 * swing, 0.0)
    earth = np.array([17_000.0, -3_500.0, 51_000.0])
    total = np.linalg.norm(earth) + 30.0 * smooth(20) + 15.0 * smooth(150)
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]), degrees=True)
    u = attitude.inv().apply(earth / np.linalg.norm(earth))
    channels = np.column_stack([
        5 + 3 * smooth(60), 2.0 * (np.sin(2 * np.pi * t / 310 + random.uniform(0, 6)) > 0.3),
        10 * smooth(2) + 0.05 * roll, 5 * smooth(3), 20 + 5 * (1 - np.exp(-t / 2000)),
        28 - 0.0005 * t + 0.2 * smooth(10), 3 * smooth(400),
        np.where(t > 0.6 * t[-1], 4.0, 0.0) + 0.1 * smooth(5),
    ])  # fmt: skip
    induced = random.normal(0, INDUCED_NT, (3, 3))
    body = u * total[:, None] + random.normal(0, PERMANENT_NT, 3) + u @ (induced + induced.T) / 2
    body += np.gradient(u, t, axis=0) @ random.normal(0, EDDY_NT_S, (3, 3))
    body += channels @ (random.normal(size=(len(CHANNELS), 3)) * FIELD_PER_UNIT_NT[:, None])
    scalar = np.linalg.norm(body, axis=1) + 0.3 * random.normal(size=n) + 0.4 * _pink(random, n) + 12.0
    if hidden:
        scalar[int(0.7 * n) : int(0.7 * n) + int(65 * RATE_HZ)] -= 3_000.0
    vector = u * total[:, None] + random.normal(0, VECTOR_NOISE_NT, (n, 3))
    return ScalarSeries(t + 1.6e9, scalar, vector, total, channels, np.full(n, np.nan))


def _pink(random: np.random.Generator, n: int) -> FloatArray:
    """Return flicker noise (n,) with standard deviation 1."""
    frequency = np.fft.rfftfreq(2 * n)[1:]
    parts = random.normal(size=(2, frequency.size)) / np.sqrt(frequency)
    series = np.fft.irfft(np.concatenate([[0], parts[0] + 1j * parts[1]]))[:n]
    return np.asarray((series - series.mean()) / series.std())


def _with_true_priors(sensor: ScalarSensor) -> ScalarSensor:
    """Return a fitted sensor as it would be if the fit had the simulation's own priors."""
    prior = np.diag(np.square(sensor.prior_sigma))
    mean, covariance = np.array(sensor.coefficients), np.array(sensor.covariance)
    data = GaussianInformation.from_posterior(mean, covariance, np.zeros(len(mean)), prior)
    swings = [channel.scale for channel in sensor.channels]
    platform = [PERMANENT_NT] * 3 + [INDUCED_NT] * 3 + [INDUCED_NT / np.sqrt(2.0)] * 3 + [EDDY_NT_S] * 9
    true = [*platform, NO_LAG_S, *np.repeat(FIELD_PER_UNIT_NT * swings, 3), CYCLE_LEVEL_SIGMA_NT]
    covariance = np.linalg.inv(data.precision + np.diag(np.array(true) ** -2.0))
    return msgspec.structs.replace(
        sensor, coefficients=tuple((covariance @ data.vector).tolist()),
        covariance=tuple(tuple(row) for row in covariance.tolist()), width_covariance=(),
    )  # fmt: skip


def _linear(train: ScalarSeries, test: ScalarSeries, method: str, channels: Any, field: float) -> FloatArray:
    """Return the field (n,) of the test half, nT, corrected by a Tolles-Lawson fit of the training half."""
    A, B = (scalar_design(part, channels, field) for part in (train, test))
    columns = np.arange(A.shape[1]) != 18  # without the lag's column
    columns[19:] = method.endswith("all")
    A, B, y = A[:, columns], B[:, columns], train.scalar - train.reference
    if method.startswith("band"):
        sections = butter(4, BAND_HZ, "bandpass", fs=RATE_HZ, output="sos")
        A, y = sosfiltfilt(sections, A, axis=0), sosfiltfilt(sections, y)
    else:
        A, B = (np.column_stack([part, np.ones(len(part))]) for part in (A, B))
    if method.startswith("least"):
        found = np.linalg.lstsq(A, y, rcond=1e-10)[0]
    else:
        found = np.linalg.solve(A.T @ A + RIDGE * np.eye(A.shape[1]), A.T @ y)
    return np.asarray(test.scalar - B @ found)


def compensate(seed: int, second: bool, known: bool, hidden: bool) -> list[dict[str, Any]]:
    """Fit one half of a flight by each method and test the other; return a row for each method."""
    whole = flight(seed, hidden)
    middle = len(whole.time) // 2
    parts = slice(middle), slice(middle, None)
    halves = [ScalarSeries(*(column[rows] for column in whole)) for rows in parts]
    train, test = halves[not second], halves[second]
    kind = "hidden" if hidden else "map" if known else "no map"
    main = np.full(middle, np.median(train.reference))
    fits = {}
    seen_train, seen_test = (half if known else half._replace(reference=main) for half in (train, test))
    for name, half in (("this fit", seen_train), ("same half", seen_test)):
        fits[name] = fit_scalar(half, CHANNELS, map_known=known)
    sensors = {name: adapt_to_log(fit.sensor, test.channels) for name, fit in fits.items()}
    sensors["true priors"] = _with_true_priors(sensors["this fit"])
    rows = []
    for method in METHODS:
        row: dict[str, Any] = {"flights": kind, "method": method}
        if method in sensors:
            found = correct_scalar(sensors[method], test)
            field, sigma = found.field, found.sigma
            total = np.linalg.norm(test.vector, axis=1)
            own = np.full(len(total), VECTOR_NOISE_NT)
            seen = compare_sensors(field, sigma, total, own, np.full(len(total), np.nan))
            error = field - test.reference
            sigma = np.sqrt(sigma**2 + seen.scalar_variance)
            row["standardised"] = float(np.sqrt(np.mean((error / sigma) ** 2)))
            row["flagged"] = 100.0 * float(seen.disagrees.mean())
        else:
            sensor = fits["this fit"].sensor
            linear = _linear(seen_train, test, method, sensor.channels, sensor.reference_field)
            error = linear - test.reference
        row |= {"rms": float(np.sqrt(np.mean(error**2))), "about_mean": float(np.std(error))}
        rows.append(row)
    return rows


def cases_of(options: argparse.Namespace) -> list[tuple[Any, ...]]:
    """Return the cases: each half of the flights, with a third as many without a map and with a source."""
    return [
        (options.first_seed + k, second, kind != "no map", kind == "hidden")
        for kind in ("map", "no map", "hidden")
        for k in range(options.flights if kind == "map" else max(1, options.flights // 3))
        for second in ((True,) if kind == "hidden" else (False, True))
    ]


STUDY = Study(
    compensate,
    ("flights", "method"),
    {
        "RMS, nT": Column("rms"),
        "worst": Column("rms", np.max),
        "about the mean": Column("about_mean"),
        "standardised": Column("standardised"),
        "5 %": Column("standardised", percentile(5)),
        "95 %": Column("standardised", percentile(95)),
        "flagged, %": Column("flagged"),
    },
)
if __name__ == "__main__":
    STUDY.main(__doc__, cases_of, flights=10, first_seed=100)
