"""Run Stone Soup's filters on the navigator's measurements, for tools/navigation.py in another interpreter.

Stone Soup (PyPI, MIT; Dstl) is a library of trackers. It needs many packages, so install it separately::

    python -m venv .venv-peers
    .venv-peers/bin/pip install stonesoup
    python tools/navigation.py --part peers --peers .venv-peers/bin/python

In: an ``.npz`` with ``prior_x`` (6,), ``prior_P`` (6, 6), and for each of n measurements ``F Q`` (n, 6, 6),
``position`` (n, 2) m north and east dead-reckoned, ``anomaly`` (n,) nT, ``variance`` (n,) nT², ``slope``
(n, 2) nT/m of the main field; ``map`` (ny, nx) nT on ``north`` (ny,) and ``east`` (nx,) m; ``particles``,
``seed``. Out, to the path given second: ``.npz`` with ``{method}_x`` (n, 6), ``{method}_P`` (n, 6, 6),
``{method}_seconds`` for ``ekf`` and ``particles``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler, SystematicResampler
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, ParticleState
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater

START = datetime(2013, 12, 5)


class FieldOnMap(NonLinearGaussianMeasurement):
    """Measurement model: anomaly on the map (bicubic spline), slope of the main field, and two biases, nT."""

    spline: RectBivariateSpline
    position: np.ndarray
    slope: np.ndarray

    @property
    def ndim_meas(self) -> int:
        """Return the number of measured values."""
        return 1

    def function(self, state: Any, noise: bool = False, **kwargs: Any) -> Any:  # noqa: ARG002  Stone Soup's signature
        """Return the predicted measurement (1, n), nT, without noise, because the updaters add the noise."""
        x = np.asarray(state.state_vector, float)
        field = self.spline(self.position[0] + x[0], self.position[1] + x[1], grid=False)
        field = field + self.slope @ x[:2] + x[4] + x[5]
        return np.atleast_2d(field).view(StateVectors if x.shape[1] > 1 else StateVector)


def problem(data: dict[str, np.ndarray]) -> Iterator[tuple[datetime, object, FieldOnMap, Detection]]:
    """Yield time, transition model, measurement model and measurement of each step."""
    spline = RectBivariateSpline(data["north"], data["east"], data["map"])
    for k in range(len(data["anomaly"])):
        model = FieldOnMap(ndim_state=6, mapping=(0,), noise_covar=CovarianceMatrix([[data["variance"][k]]]))
        model.spline, model.position, model.slope = spline, data["position"][k], data["slope"][k]
        moved = LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=data["F"][k], covariance_matrix=CovarianceMatrix(data["Q"][k])
        )
        at = START + timedelta(seconds=k + 1.0)
        yield at, moved, model, Detection(StateVector([data["anomaly"][k]]), at, measurement_model=model)


def ekf(data: dict[str, np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Run the extended Kalman filter; yield mean (6,) and covariance (6, 6) after each measurement."""
    state = GaussianState(StateVector(data["prior_x"]), CovarianceMatrix(data["prior_P"]), START)
    for at, moved, model, seen in problem(data):
        ahead = ExtendedKalmanPredictor(moved).predict(state, timestamp=at)
        state = ExtendedKalmanUpdater(model).update(SingleHypothesis(ahead, seen))
        yield np.asarray(state.mean, float).ravel(), np.asarray(state.covar, float)


def particles(data: dict[str, np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Run a bootstrap particle filter, resampled at half of the effective particles; yield as :func:`ekf`."""
    size = int(data["particles"])
    rng = np.random.default_rng(int(data["seed"]))
    np.random.seed(int(data["seed"]))  # noqa: NPY002  Stone Soup draws from the global generator
    drawn = rng.multivariate_normal(data["prior_x"], data["prior_P"], size).T
    state = ParticleState(StateVectors(drawn), weight=np.full(size, 1.0 / size), timestamp=START)
    resampler = ESSResampler(resampler=SystematicResampler())
    for at, moved, model, seen in problem(data):
        ahead = ParticlePredictor(moved).predict(state, timestamp=at)
        state = ParticleUpdater(model, resampler).update(SingleHypothesis(ahead, seen))
        yield np.asarray(state.mean, float).ravel(), np.asarray(state.covar, float)


def main() -> None:
    data = dict(np.load(sys.argv[1]))
    out: dict[str, Any] = {}
    for name, method in (("ekf", ekf), ("particles", particles)):
        begun = time.process_time()
        found = list(method(data))
        out[f"{name}_seconds"] = np.array(time.process_time() - begun)
        out[f"{name}_x"] = np.stack([x for x, _ in found])
        out[f"{name}_P"] = np.stack([P for _, P in found])
    np.savez(sys.argv[2], **out)


if __name__ == "__main__":
    main()
