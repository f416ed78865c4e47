"""Result of a fit: a calibration, its residuals, and its warnings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.left_out import LeftOut
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.pose import Posed
from magbridge.calibration.fitting.solve import CoefficientPosterior
from magbridge.calibration.model import CalibratedSensor, Calibration, Noise, Reference, Run
from magbridge.calibration.terms import Polynomial
from magbridge.diagnostics import Diagnostic
from magbridge.estimation.information import GaussianInformation
from magbridge.estimation.residual import ResidualSamples, rms, scales_and_offsets
from magbridge.version import __version__
from magbridge.wording import counted


@dataclass(frozen=True, eq=False)
class Creep:
    """Drift of the sensor's offset during a survey."""

    time: FloatArray
    """(n,): Time of the samples, s since 1970 UTC."""
    offset: FloatArray
    """(n, 3): Offset relative to the calibration's T, sensor axes, nT."""
    calibration: Calibration
    """Calibration without the variance of this drift in T."""

    def offset_at(self, time: FloatArray) -> FloatArray:
        """Return the offset (m, 3), nT, at times (m,), s since 1970 UTC."""
        return np.stack([np.interp(time, self.time, one) for one in self.offset.T], axis=1)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit."""

    calibration: Calibration
    residual: FloatArray
    """(n,): Residual ``(F - H_e) / |A^T u|``, nT as the sensor measures (before the scale factors of A)."""
    warnings: tuple[Diagnostic, ...]
    """Warnings about undetermined quantities and excluded samples."""
    details: dict[str, Any]
    """Results of the method by name: evidence, prior widths, determined coefficients, held-out errors."""
    samples: ResidualSamples
    """Samples of the fit, for :mod:`.checks`."""
    open: tuple[Diagnostic, ...] = ()
    """Quantities that the track does not determine; they become warnings, and reasons for a large error."""
    information: GaussianInformation | None = None
    """Information about the coefficients from the data alone; None if the method does not provide it."""
    creep: Creep | None = None
    """Drift of the sensor's offset during the data; None if the data do not show a drift."""

    def __repr__(self) -> str:
        count = f", {counted(len(self.calibration.warnings), 'warning')}" if self.calibration.warnings else ""
        return f"<Fit: {self.rms:.2f} nT RMS of {len(self.residual)} samples{count}; {self.calibration!r}>"

    def _repr_html_(self) -> str:
        """Return the fit as HTML for a notebook, with its warnings."""
        warnings = "".join(f"<li>{escape(warning.text)}</li>" for warning in self.warnings)
        return f"<p>{escape(repr(self))}</p>" + f"<ul>{warnings}</ul>" * bool(warnings)

    @property
    def supported(self) -> bool:
        """Return True if the data support the calibration, as the option ``--strict`` requires.

        The calibration then has no warning, such as that of a large expected error or a gap in the headings.
        """
        return not self.calibration.warnings

    @property
    def scales(self) -> tuple[float, float]:
        """Smallest and largest scale factor of A at the samples; values far from 1 suggest a collapse."""
        # 1,000 samples show the range of the scales over the positions
        step = max(len(self.samples.phi) // 1000, 1)
        scales, _ = scales_and_offsets(
            self.samples.part(slice(None, None, step)), self.calibration.without_effects().coefficients
        )
        return float(scales.min()), float(scales.max())

    @property
    def rms(self) -> float:
        """RMS of the residual, nT as the sensor measures."""
        return rms(self.residual)


def assemble(
    data: Observations,
    posed: Posed,
    found: CoefficientPosterior,
    method: str,
    left_out: LeftOut | None = None,
    details: dict[str, Any] | None = None,
    *,
    informative: bool = False,
) -> Fit:
    """Return a fit with its calibration, from the posterior of the coefficients.

    `posed`: problem of the fit. `found`: posterior. `left_out`: held-out errors; all sigmas grow by their
    ratio. `informative`: also compute the information from the data alone, without the prior.
    """
    # sigma and covariance grow by the ratio of held-out errors to claimed ones
    e, samples, noise, covariance = found.residual, found.samples, found.noise, found.covariance
    information = None
    if informative:  # of the data alone: the posterior's minus the prior's
        prior = found.prior
        before = prior.E @ np.linalg.inv(prior.precision) @ prior.E.T
        centre = np.broadcast_to(prior.offset, found.coefficients.shape)
        information = GaussianInformation.from_posterior(found.coefficients, covariance, centre, before)
    if left_out is not None:
        information = information and information.divided(left_out.ratio)
        noise, covariance = replace(noise, sigma=noise.sigma * left_out.ratio), covariance * left_out.ratio**2
        details = {**(details or {}), "left_out_nT": left_out.rms, "left_out_ratio": left_out.ratio}
    interval = float(np.median(np.diff(data.time))) if len(data) > 1 else 0.0
    calibration = Calibration(
        parameters=posed.ranges,
        terms=(Polynomial(exponents=posed.exponents),),
        coefficients=found.coefficients,
        covariance=covariance,
        noise=Noise(noise.sigma, samples.kappa * noise.sigma, noise.autocorrelation, interval, noise.white),
        reference=Reference(samples.F_0, data.model),
        sensor=CalibratedSensor(data.sensor, filter_cutoff=data.filter_cutoff),
        runs=_runs(data, e),
        method=method,
        inputs=dict(data.inputs),
        software=f"magbridge {__version__}",
    )
    return Fit(calibration, e, (), details or {}, samples, information=information)


def _runs(data: Observations, e: FloatArray) -> tuple[Run, ...]:
    """Return a summary of each run: number of samples, RMS of the residuals `e` (n,), nT, mean positions."""
    labels, which = np.unique(data.runs, return_inverse=True)
    count = np.bincount(which)
    squares = np.bincount(which, e * e)
    places = [np.bincount(which, column) / count for column in data.parameters.T]
    return tuple(
        Run(str(label), int(n), float(np.sqrt(square / n)), tuple(map(float, place)))
        for label, n, square, *place in zip(labels, count, squares, *places, strict=True)
    )
