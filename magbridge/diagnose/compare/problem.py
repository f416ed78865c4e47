r"""The comparison as a linear problem: a calibration's residuals, and what each coefficient leaves in them.

Notes
-----
With the scalar residual e of :mod:`magbridge.estimation.residual` and its derivative g by the nine
coefficients at every sample, a term or an effect that adds ``sum_rs phi_r C_krs`` to slot s moves it by

.. math:: \partial e_t / \partial c_k = \sum_{rs} \phi_r(t)\, C_{krs}\, g_s(t)

and a coefficient that the vehicle has but the calibration lacks adds minus that to the residual. Every cause
passes through the forward model by this one rule. The calibration's coefficients stay free, with its
posterior as prior (:mod:`.prior`): ``c = c_0 + L z``, ``z ~ N(m, 1)``, where L spans only the directions that
these data can determine.

Three delays are free, too: the sensor's axes may have been sampled late, and then interpolated to their rows
(:mod:`.interpolation`). That is a fault of the log, not of the vehicle, so the delays change no coefficient;
without them, a pair of large causes that cancel each other could mimic them. They have one common size
(:mod:`~magbridge.diagnose.inference.statistic`), because many logs have no such delays, and three independent
numbers absorb up to a tenth of a skew's power.

The slow part of the noise (:mod:`.slow_noise`) is free if the data need it (:func:`with_slow_noise`).

Derivatives are taken at ``H_r - e w / |w|^2``, the reading moved until its residual vanishes: at the reading
itself they would correlate with its noise, and scales could grow against offsets until they fit the noise
(errors in variables).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.correct import regressors
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import Effect, Series
from magbridge.diagnose.compare.derivatives import DERIVATIVE_ROWS, derivatives
from magbridge.diagnose.compare.interpolation import interpolation_error
from magbridge.diagnose.compare.prior import noise_sigma, prior
from magbridge.diagnose.compare.slow_noise import slow_columns, waves
from magbridge.diagnose.compare.survey import Survey
from magbridge.estimation.residual import Samples, residuals

__all__ = [
    "AXIS_DELAY_SIGMA_S",
    "DELAYS",
    "Problem",
    "linearised",
    "once",
    "pose",
    "samples_of",
    "with_slow_noise",
]

T = TypeVar("T")

AXIS_DELAY_SIGMA_S = 0.3
"""s, a plausible size of an axis' delay after its row."""
DELAYS = slice(-3, None)
"""Places of the axes' delays in z."""
MIN_INFORMATION = 0.01
"""Share of a prior's information that data must add for its direction to be kept."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A survey compared with a calibration and linearised: what a search works on."""

    survey: Survey
    calibration: Calibration
    reading: FloatArray
    """(n, 3) nT, ``H_r - e w / |w|^2``: for effects that depend on the reading, which must not contain its
    noise."""
    residual: FloatArray
    """(n,) e, in the sensor's nanotesla."""
    jacobian: FloatArray
    """(n, 9) g."""
    reference_jacobian: FloatArray
    """(n,) 1/s of :mod:`magbridge.estimation.residual`: e per nT by which the true field exceeds the
    reference."""
    delay_jacobian: FloatArray
    """(n, 3) ``-de/dz`` of the delays, in units of :data:`AXIS_DELAY_SIGMA_S`."""
    directions: FloatArray
    """(K, q) L; zero for slow noise and the delays."""
    centre: FloatArray
    """(q,) m, prior mean of z."""
    unseen: FloatArray
    """(K, K) nT², covariance in the directions that these data cannot see."""
    waves: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(k,) of each coefficient of slow noise, what its variance falls with: the number of half waves per log,
    or a power of it. There are none where the noise has no such part."""

    def __len__(self) -> int:
        return len(self.residual)

    def channels_of(self, kind: str) -> list[str]:
        """Name the channels that may be of this kind, except the calibration's own parameters."""
        own = {parameter.name for parameter in self.calibration.parameters}
        return [name for name, c in self.survey.channels.items() if kind in c.kinds and name not in own]

    @property
    def known(self) -> slice:
        """Places in z of the calibration's own coefficients."""
        return slice(len(self.centre) - len(self.waves) - 3)

    @property
    def slow(self) -> slice:
        """Places in z of slow noise."""
        return slice(self.known.stop, len(self.centre) - 3)

    def slow_noise(self, z: FloatArray) -> FloatArray:
        """(n,) what slow noise of z (q,) adds to the residual."""
        if not self.waves.size:
            return np.zeros(len(self))
        return np.asarray(self.calibration_jacobian[:, self.slow] @ z[self.slow])

    def series(self, effect: Effect, rows: slice = slice(None)) -> Series:
        """Return rows of the log as the array form of an effect takes them."""
        names = dict.fromkeys([*(p.name for p in self.calibration.parameters), *effect.channels()])
        values = {name: self.survey.channels[name].values[rows] for name in names}
        return Series(self.survey.time[rows], self.reading[rows], values, self.calibration.kernel)

    @cached_property
    def calibration_jacobian(self) -> FloatArray:
        """(n, q) ``-de/dz``; the delays' are :attr:`delay_jacobian`, slow noise is in nT."""
        samples, _ = samples_of(self.survey, self.calibration)
        found = derivatives(self.calibration, samples, self.jacobian, -self.directions)
        found[:, DELAYS] = self.delay_jacobian
        if self.waves.size:
            found[:, self.slow] = slow_columns(self.jacobian[:, 6:])
        return found

    def let_go(self) -> None:
        """Release :attr:`calibration_jacobian` (300 MB for a month); it is computed again when needed."""
        self.__dict__.pop("calibration_jacobian", None)

    @property
    def stated(self) -> FloatArray:
        """(n,) nT², variance that the calibration states: of the noise, and of its coefficients."""
        noise, J = self.calibration.noise, self.calibration_jacobian[:, self.known]
        return np.asarray(noise.sensor**2 + noise.reference**2 + np.einsum("ij,ij->i", J, J))

    def straight(self, z: FloatArray) -> FloatArray:
        """(n,) residual without what the axes' delays in z (q,) add to it."""
        return np.asarray(self.residual - self.delay_jacobian @ z[DELAYS])


def once(made: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Cache a function's result for each problem: causes share regressors, of 50 MB for a month."""
    known: WeakKeyDictionary[Problem, T] = WeakKeyDictionary()

    @wraps(made)
    def of(problem: Problem) -> T:
        if problem not in known:
            known[problem] = made(problem)
        return known[problem]

    return of


def samples_of(survey: Survey, calibration: Calibration) -> tuple[Samples, FloatArray]:
    """Return the residual's samples, with effects among the regressors, and its coefficients (9 m,)."""
    phi = regressors(calibration, survey.field, survey.values(calibration.channels), survey.time)
    unit = calibration.reference.field
    W = calibration.kernel.weights.copy()
    W[0, :3] -= 1.0
    W[:, :6] *= unit
    noise = calibration.noise
    kappa = noise.reference / noise.sensor if noise.sensor > 0.0 else 0.0
    return Samples(survey.field, survey.reference, phi.T, survey.steps.astype(float), unit, kappa), W.ravel()


def linearised(
    samples: Samples, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute the residual and its derivatives at readings that are moved until the residual vanishes.

    Parameters
    ----------
    samples : Samples
        n samples, with m regressors.
    coefficients : (9 m,) array
        Coefficients of all regressors, nT.

    Returns
    -------
    (n,), (n, 9), (n,), (n, 3) array
        Residual (sensor nT), its derivative by the nine coefficients, its derivative by the true field, and
        the moved readings (nT).
    """
    n = len(samples.field)
    e, g, reference_jacobian, reading = np.empty(n), np.empty((9, n)).T, np.empty(n), np.empty((n, 3))
    for start in range(0, n, DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        part = samples.part(rows)
        e[rows], slope = residuals(part, coefficients)
        # Errors in variables: move the reading along its own gradient until the residual vanishes
        away = slope[:, 6:]
        reading[rows] = part.field + (e[rows] / (away * away).sum(axis=1))[:, None] * away
        _, g[rows] = residuals(replace(part, field=reading[rows]), coefficients)
        above, _ = residuals(replace(part, reference=part.reference + 1.0), coefficients)
        reference_jacobian[rows] = e[rows] - above
    return e, g, reference_jacobian, reading


def pose(survey: Survey, calibration: Calibration) -> Problem:
    """Linearise the comparison about `calibration`."""
    samples, coefficients = samples_of(survey, calibration)
    n = len(survey)
    e, g, reference_jacobian, reading = linearised(samples, coefficients)
    L, centre = prior(survey, calibration, samples, e, g)
    seen = np.zeros((L.shape[1],) * 2)
    for start in range(0, n, DERIVATIVE_ROWS):
        rows = slice(start, start + DERIVATIVE_ROWS)
        J = derivatives(calibration, samples.part(rows), g[rows], L)
        seen += J.T @ J
    values, vectors = np.linalg.eigh(seen / noise_sigma(calibration, e) ** 2)
    keep = values > MIN_INFORMATION
    V, rest = vectors[:, keep], L @ vectors[:, ~keep]
    delay_jacobian = -AXIS_DELAY_SIGMA_S * g[:, 6:] * interpolation_error(survey, reading.T).T
    directions, centre = np.hstack([L @ V, np.zeros((len(L), 3))]), np.append(V.T @ centre, np.zeros(3))
    return Problem(
        survey, calibration, reading, e, g, reference_jacobian, delay_jacobian, directions, centre,
        rest @ rest.T,
    )  # fmt: skip


def with_slow_noise(problem: Problem, power: int = 1) -> Problem:
    """Return the problem with slow noise, its power 1/f or that to a higher `power`.

    Its coefficients are places of z that move no calibration.
    """
    if problem.waves.size:
        return replace(problem, waves=waves() ** power)
    at, more = problem.known.stop, np.zeros(waves().size)
    return replace(
        problem,
        directions=np.insert(problem.directions, at, more[:, None], axis=1),
        centre=np.insert(problem.centre, at, more),
        waves=waves() ** power,
    )
