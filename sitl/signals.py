"""Causal, exact discretisations of a first-order lag and of autocorrelated noise."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from magbridge.arrays import FloatArray

__all__ = ["autoregressive", "correlated", "first_order", "first_order_at"]


def first_order(
    u: FloatArray, step: float, time_constant: float, start: FloatArray | float | None = None
) -> FloatArray:
    r"""Return the output of a first-order lag, of the shape of its input u (n,) or (n, k), every `step` s.

    The output begins at `start` (k,), or at ``u[0]``. A time constant of 0 s passes the input through.

    Notes
    -----
    :math:`\tau \dot y = u - y` with u linear over a step h has the exact solution

    .. math:: y_{k+1} = a y_k + (\rho - a) u_k + (1 - \rho) u_{k+1},
              \quad a = e^{-h/\tau}, \quad \rho = (1 - a) \tau / h

    (first-order hold: Franklin, Powell & Workman, *Digital Control of Dynamic Systems*, sec. 6.3).
    """
    if time_constant == 0:
        return u.copy()
    a = np.exp(-step / time_constant)
    rho = -np.expm1(-step / time_constant) * time_constant / step
    first = u[0] if start is None else np.broadcast_to(start, u[0].shape)
    # direct form II transposed: y_0 = b_0 u_0 + z must give `first`
    state = (first - (1 - rho) * u[0])[None]
    y, _ = lfilter([1 - rho, rho - a], [1.0, -a], u, axis=0, zi=state)
    return np.asarray(y, dtype=np.float64)


def first_order_at(
    u: FloatArray, y: FloatArray, step: float, time_constant: float, time: FloatArray
) -> FloatArray:
    r"""Return a first-order lag's output (m,) at any times between the points of its grid.

    Input u and output y (n,) on the grid are from :func:`first_order`. `time` (m,) is s after the first
    point, within the grid.

    Notes
    -----
    Within a step, :math:`y(s) = a y_k + (1 - a)(u_k - c \tau) + c s` with :math:`a = e^{-s/\tau}` and c the
    slope of u.
    """
    k = np.clip(np.floor(time / step).astype(np.intp), 0, len(u) - 2)
    s = time - k * step
    slope = (u[k + 1] - u[k]) / step
    if time_constant == 0:
        return np.asarray(u[k] + slope * s)
    a = np.exp(-s / time_constant)
    return np.asarray(a * y[k] + (1 - a) * (u[k] - slope * time_constant) + slope * s)


def autoregressive(
    rng: np.random.Generator, shape: tuple[int, ...], sigma: float, memory: float
) -> FloatArray:
    """Return stationary AR(1) noise (n, ...) with a correlation length of `memory` points of the first axis.

    `sigma` is the standard deviation of the noise itself, not of its innovations. A `memory` of 0 gives white
    noise.
    """
    white = rng.normal(0.0, sigma, shape)
    return correlated(white, np.exp(-1.0 / memory)) if memory else white


def correlated(white: FloatArray, phi: float) -> FloatArray:
    """Convert white noise (n, ...) to AR(1) noise of the same variance and lag-1 correlation `phi`."""
    driven = np.concatenate([white[:1], np.sqrt(1 - phi**2) * white[1:]])
    return np.asarray(lfilter([1.0], [1.0, -phi], driven, axis=0), dtype=np.float64)
