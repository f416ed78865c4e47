"""Python version of MagNav.jl's linear online filter, the third-party baseline of in-flight calibration.

In ``ekf_online`` (MagNav.jl; Canciani 2022, IEEE Trans. Aerospace and Electronic Systems 58:420), the states
are the 18 coefficients of Tolles and Lawson and a first-order Gauss-Markov field. The coefficients belong to
permanent, induced and eddy-current terms: products of direction cosines and their rates. The filter has no
terms for moving masses, so its input is the field after the fixed calibration.
"""

from __future__ import annotations

import numpy as np

PERMANENT, INDUCED, EDDY = 20.0, 20.0, 5.0
"""Prior 1-sigma of the three kinds of terms, nT: a power-on's offset change; an eddy term at 1 deg/s."""
WALK = 3.0 / 86_400.0**0.5
"""Random walk of the coefficients, nT per square root of a second, as in magbridge."""
PAIRS = tuple((i, j) for i in range(3) for j in range(i, 3))


def features(vector: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the 18 terms (n, 18) of Tolles and Lawson for a measured vector (n, 3)."""
    u = vector / np.linalg.norm(vector, axis=1)[:, None]
    rate = np.gradient(u, time, axis=0) / np.radians(1.0)
    induced = [u[:, i] * u[:, j] for i, j in PAIRS]
    eddy = [u[:, i] * rate[:, j] for i in range(3) for j in range(3)]
    return np.column_stack([u, *induced, *eddy])


def online(
    vector: np.ndarray,
    total: np.ndarray,
    reference: np.ndarray,
    time: np.ndarray,
    use: np.ndarray,
    noise: float,
    field: tuple[float, float],
) -> np.ndarray:
    """Return the total field (n,), nT, that the filter corrects sample by sample.

    `vector` (n, 3) and `total` (n,), nT, are corrected by the fixed calibration; `reference` (n,) is in nT,
    `time` (n,) in s. The mask `use` (n,) selects the samples that update the filter; `noise` is in nT.
    `field` is the 1-sigma (nT) and the time constant (s) of the Gauss-Markov field.
    """
    A = features(vector, time)
    x = np.zeros(19)
    P = np.diag(np.r_[[PERMANENT**2] * 3, [INDUCED**2] * 6, [EDDY**2] * 9, field[0] ** 2])
    out = np.empty(len(time))
    last = time[0]
    for k in range(len(time)):
        phi = np.exp(-(time[k] - last) / field[1])
        x[-1] *= phi
        P[-1] *= phi
        P[:, -1] *= phi
        P[-1, -1] += field[0] ** 2 * (1.0 - phi * phi)
        P[range(18), range(18)] += WALK**2 * (time[k] - last)
        last = time[k]
        out[k] = total[k] - A[k] @ x[:-1]
        if use[k]:
            h = np.r_[A[k], 1.0]
            improvement = P @ h / (h @ P @ h + noise**2)
            x += improvement * (total[k] - reference[k] - h @ x)
            P -= np.outer(improvement, h @ P)
            P = 0.5 * (P + P.T)
    return out
