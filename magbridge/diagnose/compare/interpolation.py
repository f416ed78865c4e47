"""Rates of change of sampled axes, and the error of axes that were interpolated to their rows."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from magbridge.arrays import FloatArray
from magbridge.diagnose.compare.survey import Survey

__all__ = ["MAX_MISSING_SAMPLES", "interpolation_error", "rates"]

MAX_MISSING_SAMPLES = 3
"""Largest number of samples missing in a row within a leg: the rate next to such a gap still has 98 % of the
true one's power."""


def rates(survey: Survey, H: FloatArray, order: int = 1) -> FloatArray:
    r"""(k, n) first or second derivative of H (k, n): of the cubic spline through each leg; zero at its ends.

    A leg is a run of samples in which no gap is longer than :data:`MAX_MISSING_SAMPLES` samples.

    Notes
    -----
    Of an oscillation of angular frequency w, sampled every h, a central difference returns only
    ``sin(wh)/wh = 1 - (wh)^2/6 + ...`` of the rate, so a coefficient fitted to it would be too large by as
    much. The spline returns ``3 sin(wh)/(wh (2 + cos(wh))) = 1 - (wh)^4/180 + ...``.

    The rates ``D e`` of noise e, of covariance Sigma, correlate with the noise:
    :math:`E[(D e)^T \Sigma^{-1} e] = \mathrm{tr} D`, whatever Sigma is. A one-sided difference has a trace,
    which would pass for an effect; the spline treats both directions of time equally and has none.
    """
    t, out = survey.time, np.zeros_like(H)
    starts = np.flatnonzero(~survey.follows(MAX_MISSING_SAMPLES))
    for start, end in zip(starts, np.append(starts[1:], len(t)), strict=True):
        if end - start > 2:
            spline = CubicSpline(t[start:end], H[:, start:end], axis=1).c
            out[:, start + 1 : end - 1] = order * spline[3 - order, 1:].T
    return out


def interpolation_error(survey: Survey, H: FloatArray) -> FloatArray:
    r"""(3, n) error of axes H (3, n) sampled late and interpolated to their row, nT per s of delay.

    Linear interpolation is in error when the vehicle sways from sample to sample. `H` must be free of the
    readings' noise: the difference is one-sided and would correlate with it.

    Notes
    -----
    An axis sampled tau after its row, and interpolated linearly from there and from the sample before it
    (H_-, an interval h earlier), reads at its row (H_0)

    .. math:: H(t + \tau) - \frac{\tau}{h} \left(H(t + \tau) - H(t - h + \tau)\right)
              \approx H + \tau \left(\dot H - \frac{H_0 - H_-}{h}\right)
    """
    rate, follows = rates(survey, H), survey.follows()
    at = np.flatnonzero(follows & rate.any(axis=0))
    out = np.zeros_like(H)
    out[:, at] = rate[:, at] - (H[:, at] - H[:, at - 1]) / (survey.time[at] - survey.time[at - 1])
    return out
