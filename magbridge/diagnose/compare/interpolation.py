"""Between a log's samples: rates of change along its legs, and what interpolated channels lost there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from magbridge.diagnose.compare.survey import Survey

__all__ = ["LOST", "bent", "rates"]

FloatArray = NDArray[np.float64]

LOST = 3
"""Samples between two that may be lost: the rate beside them still holds 98 % of the true one's power."""


def rates(survey: Survey, H: FloatArray) -> FloatArray:
    r"""(k, n) dH/dt, per s, of H (k, n): of the cubic spline through a leg's samples; zero at its ends.

    Notes
    -----
    Of a turn of angular frequency w, sampled every h, a difference both ways holds
    ``sin(wh)/wh = 1 - (wh)^2/6 + ...``, and its coefficient would be too large by as much; the spline
    ``3 sin(wh)/(wh (2 + cos(wh))) = 1 - (wh)^4/180 + ...``.

    Rates ``D e`` of noise e have the inner product :math:`E[(D e)^T \Sigma^{-1} e] = \mathrm{tr} D` with
    itself, whatever its covariance. That of a one-sided difference would pass for an effect; a spline has
    nothing, being the same backwards.
    """
    t, out = survey.time, np.zeros_like(H)
    starts = np.flatnonzero(~survey.follows(LOST))
    for start, end in zip(starts, np.append(starts[1:], len(t)), strict=True):
        if end - start > 2:
            out[:, start + 1 : end - 1] = CubicSpline(t[start:end], H[:, start:end], axis=1).c[2, 1:].T
    return out


def bent(survey: Survey, H: FloatArray) -> FloatArray:
    r"""(3, n) nT/s of H (3, n): what a second's delay leaves in a channel interpolated linearly to its row.

    A vehicle that sways from sample to sample is not where a line has it. `H` must not hold the noise: the
    difference is one-sided, and would find its own.

    Notes
    -----
    Sampled tau after its row, h after the sample before, the channel reads

    .. math:: H(t + \tau) - \frac{\tau}{h} \left(H(t + \tau) - H(t - h + \tau)\right)
              \approx H + \tau \left(\dot H - \frac{H_0 - H_-}{h}\right)
    """
    rate, follows = rates(survey, H), survey.follows()
    at = np.flatnonzero(follows & rate.any(axis=0))
    out = np.zeros_like(H)
    out[:, at] = rate[:, at] - (H[:, at] - H[:, at - 1]) / (survey.time[at] - survey.time[at - 1])
    return out
