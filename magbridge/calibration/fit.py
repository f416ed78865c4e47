"""Fit a calibration: one door, and a table of methods behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import magbridge
from magbridge.calibration.data import Observations
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference, Run, Sensor
from magbridge.calibration.noise import NoiseModel
from magbridge.calibration.residual import Samples, residuals
from magbridge.calibration.terms import Polynomial
from magbridge.errors import CalibrationError

__all__ = ["METHODS", "Fit", "fit"]

FloatArray = NDArray[np.float64]

METHODS: dict[str, str] = {
    "auto": "magbridge.calibration.auto:fit_auto",
    "nominal": "magbridge.calibration.fit:fit_nominal",
    "cubic": "magbridge.calibration.cubic:fit_cubic",
    "per_run": "magbridge.calibration.per_run:fit_per_run",
    "horizontal": "magbridge.calibration.horizontal:fit_horizontal",
}
"""Name -> ``module:function``, each ``(observations, order, **options) -> Fit``."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What a fit gives back.

    Attributes
    ----------
    calibration : Calibration
    residual : (n,) array
        nT in the sensor's own units: ``(F - H_e) / |A^T u|``.
    warnings : tuple of str
        What the data could not tell, in a pilot's words.
    details : dict
        Numbers of the method: evidence, rank, widths.
    """

    calibration: Calibration
    residual: FloatArray
    warnings: tuple[str, ...]
    details: dict[str, Any]

    @property
    def rms(self) -> float:
        """RMS of the residual, nT."""
        return float(np.sqrt(np.mean(self.residual**2)))


def fit(data: Observations, method: str = "auto", order: int = 3, **options: Any) -> Fit:
    """Fit a calibration to `data`.

    Parameters
    ----------
    data : Observations
    method : str
        One of :data:`METHODS`.
    order : int
        Highest total degree of the polynomials.
    **options
        The method's own.

    Raises
    ------
    CalibrationError
        The data do not support the fit, or there is no such method.
    """
    if method not in METHODS:
        raise CalibrationError(f"method {method!r} is not known: one of {', '.join(METHODS)}")
    module, _, name = METHODS[method].partition(":")
    chosen: Callable[..., Fit] = getattr(import_module(module), name)
    # one thread: matrices this small only wait for each other, and sums keep one order on any machine
    with threadpool_limits(1, "blas"):
        return chosen(data, order, **options)


def fit_nominal(data: Observations, order: int = 0, **options: Any) -> Fit:  # noqa: ARG001  (one ellipsoid has none)
    """:func:`~magbridge.calibration.nominal.nominal` as a calibration without parameters."""
    from magbridge.calibration.nominal import nominal, nominal_samples  # noqa: PLC0415  (a cycle else)

    coefficients, covariance, noise = nominal(data, **options)
    return assemble(data, nominal_samples(data), (), ((),), coefficients, covariance, noise, "nominal")


def assemble(
    data: Observations,
    samples: Samples,
    parameters: tuple[Parameter, ...],
    exponents: tuple[tuple[int, ...], ...],
    coefficients: FloatArray,
    covariance: FloatArray,
    noise: NoiseModel,
    method: str,
    warnings: tuple[str, ...] = (),
    details: dict[str, Any] | None = None,
) -> Fit:
    """Put a fit's numbers into a calibration with its run table."""
    e, _ = residuals(samples, coefficients)
    assert data.runs is not None
    assert data.time is not None
    table = tuple(
        Run(
            label=str(label),
            samples=int((data.runs == label).sum()),
            rms=float(np.sqrt(np.mean(e[data.runs == label] ** 2))),
            parameters=tuple(data.parameters[data.runs == label].mean(axis=0).tolist()),
        )
        for label in np.unique(data.runs)
    )
    steps = np.diff(data.time)
    calibration = Calibration(
        parameters=parameters,
        terms=(Polynomial(exponents=exponents),),
        coefficients=coefficients,
        covariance=covariance,
        noise=Noise(
            noise.sigma,
            samples.kappa * noise.sigma,
            noise.memory,
            float(np.median(steps)) if steps.size else 0.0,
        ),
        reference=Reference(samples.unit, data.model),
        sensor=Sensor(data.sensor),
        runs=table,
        method=method,
        inputs=dict(data.inputs),
        software=f"magbridge {magbridge.__version__}",
    )
    return Fit(calibration, e, warnings, details or {})
