"""Correct raw samples, many at once, with the functions that :class:`.corrector.Corrector` uses for one.

:func:`forward` is the inverse, from the true field to the readings: ``H_r = A^-1 R^T H + T``. Effects that
depend on the reading itself are solved for by iteration; all others are exact in the first pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import NamedTuple

import numpy as np

from magbridge.arrays import FloatArray, IntArray
from magbridge.calibration.corrector import (
    EXTRAPOLATED,
    GAP,
    STALE_TELEMETRY,
    base_flags,
    begun,
    omega,
    ranges,
)
from magbridge.calibration.kernel import Kernel, Prepared, apply, prepare, variances
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import LogSeries, Step
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import PAIRS, symmetric
from magbridge.records import MAX_MEASURED_NT

CORRECTED_AT_ONCE = 4096
"""Samples at a time: enough to outweigh the overhead of a call, few enough for a core's cache."""


class CorrectedArrays(NamedTuple):
    """Corrected samples as arrays: nT, and :class:`~magbridge.records.Quality` bits."""

    total: FloatArray
    sigma: FloatArray
    """`total`, `sigma`: (n,)."""
    vector: FloatArray
    vector_sigma: FloatArray
    """`vector`, `vector_sigma`, (n, 3): Body axes; sensor axes where ``no_boresight`` is set."""
    quality: IntArray
    """(n,)."""


def correct(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> CorrectedArrays:
    """Correct many samples; within 1e-12 of the field what :class:`~.corrector.Corrector` gives one by one.

    Parameters
    ----------
    calibration : Calibration
        Of the sensor that took the samples.
    field : (n, 3) array
        nT, raw, sensor axes.
    channels : (n, k) array
        ``calibration.channels``, in that order; NaN where unknown.
    time : (n,) array
        s since 1970 UTC, ascending: effects may have a state.

    Returns
    -------
    CorrectedArrays

    Raises
    ------
    CalibrationError
        Another number of columns than the calibration's channels.
    """
    field = np.asarray(field, float)
    n = len(field)
    channels = np.asarray(channels, float).reshape(n, -1)
    if channels.shape[1] != len(calibration.channels):
        raise CalibrationError(
            f"expected {len(calibration.channels)} channels ({', '.join(calibration.channels)}), "
            f"found {channels.shape[1]}"
        )
    out, turn = np.empty((8, n)), omega(calibration)
    with np.errstate(all="ignore"):  # NaN in, NaN out: flagged below
        for part, prepared in _prepared_blocks(calibration, field, channels, time):
            hx, hy, hz = field[part].T
            out[:, part] = apply(hx, hy, hz, prepared, turn, np.sqrt)
        # The flags of :class:`~.corrector.Corrector`, for arrays.
        quality = np.full(n, base_flags(calibration))
        for value, (low, high) in zip(channels.T, ranges(calibration), strict=False):
            quality |= np.where((value < low) | (value > high), EXTRAPOLATED, 0)
            quality |= np.where(np.isnan(value), STALE_TELEMETRY, 0)
        lost = ~(out[0] < MAX_MEASURED_NT)
        measured = np.abs(field).sum(axis=1) < MAX_MEASURED_NT
        quality |= np.where(lost, np.where(measured, STALE_TELEMETRY, GAP), 0)
    out[np.ix_([0, 2, 3, 4], lost)] = np.nan
    out[np.ix_([1, 5, 6, 7], lost)] = inf
    return CorrectedArrays(out[0], out[1], out[2:5].T, out[5:8].T, quality)


def vector_covariance(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the covariance of the corrected vector, without the boresight's part, (n, 3, 3) nT^2.

    Arguments as for :func:`correct`.

    Notes
    -----
    ``V_ij = Q_ij . (d d^T) + L_ij . d + O_ij`` with ``d = H_r - T`` (:mod:`.kernel`).
    """
    out = np.empty((len(field), 3, 3))
    with np.errstate(all="ignore"):
        for part, (linear, V) in _prepared_blocks(calibration, field, channels, time):
            # d = H_r - T, then the six entries of V.
            d = field[part].T - np.stack(linear[9:12])
            for (i, j), value in zip(PAIRS, variances(d[0], d[1], d[2], V), strict=True):
                out[part, i, j] = out[part, j, i] = value
    return out


def _prepared_blocks(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> Iterator[tuple[slice, Prepared]]:
    """Yield blocks of rows that fit the cache, in order of time because effects have a state."""
    steps = begun(calibration)
    for start in range(0, len(field), CORRECTED_AT_ONCE):
        part = slice(start, start + CORRECTED_AT_ONCE)
        phi = _regressors(calibration.kernel, steps, field[part], channels[part], time[part])
        yield part, _prepare_many(calibration.kernel, phi)


def _regressors(
    kernel: Kernel, steps: list[Step], field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return (m, n) regressors: monomials vectorised; effects sample by sample, because they have a state."""
    phi = kernel.monomials(list(channels.T), np.ones(len(field)))
    if steps:
        times = np.rint(np.asarray(time) * 1e6).astype(np.int64).tolist()
        samples = list(zip(times, *field.T.tolist(), channels.tolist(), strict=True))
        for step in steps:
            phi += list(np.array([step(*sample) for sample in samples]).T)
    return np.stack(phi)


def regressors(
    calibration: Calibration, field: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return (m, n) regressors of every sample, from a fresh state, in the effects' array form.

    Arguments as for :func:`correct`, which steps through the effects as the bridge does.
    """
    kernel, channels = calibration.kernel, channels.reshape(len(field), -1)
    series = LogSeries(time, field, dict(zip(calibration.channels, channels.T, strict=True)), kernel)
    positions = list(channels.T)[: len(kernel.centre)]
    phi = [*kernel.monomials(positions, np.ones(len(field)))]
    for effect in calibration.effects:
        phi += list(effect.batch(series))
    return np.stack(phi)


def _prepare_many(kernel: Kernel, phi: FloatArray) -> Prepared:
    """Prepare (m, n) regressors; if most repeat the sample before, once for each stretch of equal ones."""
    # At rest the regressors of successive samples are equal: prepare each stretch once, and repeat it.
    new = np.ones(phi.shape[1], bool)
    new[1:] = (phi[:, 1:] != phi[:, :-1]).any(axis=0)
    if 2 * np.count_nonzero(new) > len(new):
        return prepare(list(kernel.sums(phi)))
    phi = phi[:, new]
    linear, V = prepare(list(kernel.sums(phi)))
    back = np.cumsum(new) - 1
    return [row[back] for row in linear], [[row[back] for row in entry] for entry in V]


def forward(
    calibration: Calibration, field_body: FloatArray, channels: FloatArray, time: FloatArray
) -> FloatArray:
    """Return the noiseless readings in a true field.

    Parameters
    ----------
    calibration : Calibration
        Of the simulated sensor.
    field_body : (n, 3) array
        nT, the true field in body axes (in the calibration's sensor axes if it has no boresight).
    channels : (n, k) array
        ``calibration.channels``, in that order.
    time : (n,) array
        s.

    Returns
    -------
    (n, 3) array
        nT, raw channels.
    """
    truth = np.asarray(field_body, float)
    if calibration.boresight is not None:
        truth = truth @ calibration.boresight.matrix()
    reading = truth
    # the first pass is exact unless effects depend on the reading; each further one then gains two digits
    for _ in range(6 if calibration.effects else 1):
        # the nine coefficients at every sample, with effects
        phi = regressors(calibration, reading, np.asarray(channels, float), time)
        theta = phi.T @ calibration.kernel.weights
        reading = np.linalg.solve(symmetric(theta), truth[:, :, None])[:, :, 0] + theta[:, 6:]
    return reading
