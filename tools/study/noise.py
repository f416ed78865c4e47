"""What makes an effect hard to find: a log's noise, and its lost samples."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray, IndexArray
from sitl.signals import correlated

Rows = IndexArray
MEMORY = 0.8
"""Correlation of neighbouring samples in autoregressive noise."""
SLOWER = 0.95
"""Correlation of neighbouring samples in the autoregressive third (by power) of mixed noise."""
NOISES = ("white", "ar", "mixed", "heavy", "uneven", "half", "map")
"""White; autoregressive; white plus slower autoregressive; heavy-tailed; louder at times; half as loud again
as calibrated; white over rock of a stronger field."""
FLICKER, CORNER = "flicker", 0.1
"""Noise of 1 nT RMS whose power grows as 1/f down to the length of the log, and the share of the sampling
frequency at which that begins."""
GLIDER = "glider"
"""The noise of the paper's twin: eight times as large, and correlated."""
LOSSES = ("single", "bursts", "hole", "surfacing")
"""What is lost: one sample in twenty; two minutes or so, a dozen times; a sixth of the log at once; 44 s of
every dive."""


def statistics(noise: str) -> tuple[float, float]:
    """Correlation of neighbouring samples, and 1-sigma (nT), with which theory whitens this noise."""
    return (MEMORY if noise in ("ar", GLIDER) else 0.0), {"half": 1.5, GLIDER: 8.0}.get(noise, 1.0)


def add_noise(ds: xr.Dataset, kind: str, seed: int) -> xr.Dataset:
    """Add noise of its `kind` to each channel, of unit variance unless the kind says otherwise."""
    rng = np.random.default_rng([seed, 99])
    n = ds.sizes["time"]
    noise = rng.standard_normal((n, 3))
    if kind == "heavy":
        noise = rng.standard_t(4.0, (n, 3)) / np.sqrt(2.0)
    if kind == FLICKER:
        power = 1.0 + CORNER / np.maximum(np.fft.rfftfreq(n), 1.0 / n)[:, None]
        noise = np.fft.irfft(np.fft.rfft(noise, axis=0) * np.sqrt(power), n, axis=0)
        noise /= noise.std()
    if kind in ("ar", GLIDER):
        noise = correlated(noise, MEMORY)
    if kind == "mixed":
        noise = np.sqrt(2 / 3) * noise + np.sqrt(1 / 3) * correlated(rng.standard_normal((n, 3)), SLOWER)
    if kind == "uneven":
        noise *= np.repeat(np.exp(rng.normal(0, 0.5, n // 300 + 1)), 300)[:n, None]
    out = ds.copy()
    for k, axis in enumerate("xyz"):
        out[f"mag_{axis}"] = out[f"mag_{axis}"] + statistics(kind)[1] * noise[:, k]
    return out


def kept_rows(losses: str, n: int, seed: int) -> Rows:
    """Rows of a log that are kept; all of its n rows where `losses` is empty."""
    rng = np.random.default_rng([seed, 98])
    there = np.ones(n, bool)
    if losses == "single":
        there = rng.random(n) > 0.05
    if losses == "bursts":
        for start, length in zip(rng.integers(0, n, 12), rng.geometric(1 / 30, 12), strict=True):
            there[start : start + length] = False
    if losses == "hole":
        start = rng.integers(1, n - n // 6)
        there[start : start + n // 6] = False
    if losses == "surfacing":
        dive = rng.integers(50, 300)
        there[(np.arange(n) + rng.integers(dive)) % dive < 11] = False
    return np.flatnonzero(there)


def whiten(x: FloatArray, noise: str, rows: Rows) -> FloatArray:
    """Innovations, in units of their 1-sigma under the true noise, of a signal x sampled at `rows` alone.

    Over a step of k rows an AR(1) is one of ``rho^k``. The first row has no past and is left out.
    """
    memory, sigma = statistics(noise)
    rho = (memory ** np.diff(rows)).reshape(-1, *[1] * (x.ndim - 1))
    return np.asarray((x[1:] - rho * x[:-1]) / (sigma * np.sqrt(1 - rho**2)))
