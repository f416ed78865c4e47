"""The result of a fit: a calibration, its residuals, and its warnings."""

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
    """Drift of the offset during a survey."""

    time: FloatArray
    """(n,), s since 1970 UTC."""
    offset: FloatArray
    """(n, 3), nT, sensor axes, about the mean."""
    calibration: Calibration
    """Calibration without the walk; beyond the survey the offset may have any value of it."""

    def offset_at(self, time: FloatArray) -> FloatArray:
        """Return the offset (m, 3), nT, at times (m,), s since 1970 UTC."""
        return np.stack([np.interp(time, self.time, one) for one in self.offset.T], axis=1)


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit."""

    calibration: Calibration
    residual: FloatArray
    """(n,), nT in the sensor's own units: ``(F - H_e) / |A^T u|``."""
    warnings: tuple[Diagnostic, ...]
    """What the data could not determine, and which samples were left out."""
    details: dict[str, Any]
    """Numbers of the method: evidence, widths, how many numbers were determined; rank, and the 1-sigma of
    each estimable combination from the data alone (nT)."""
    samples: ResidualSamples
    """The data as fitted, for :mod:`.checks`."""
    open: tuple[Diagnostic, ...] = ()
    """What the track leaves open, which is a reason for an error that is large."""
    information: GaussianInformation | None = None
    """What the data alone say of the coefficients; None where the method's prior is none of all of them."""
    creep: Creep | None = None
    """How the sensor's offset crept meanwhile, where the data show that it did."""

    def __repr__(self) -> str:
        count = f", {counted(len(self.calibration.warnings), 'warning')}" if self.calibration.warnings else ""
        return f"<Fit: {self.rms:.2f} nT RMS of {len(self.residual)} samples{count}; {self.calibration!r}>"

    def _repr_html_(self) -> str:
        """Return the same for a notebook, with the warnings."""
        warnings = "".join(f"<li>{escape(warning.text)}</li>" for warning in self.warnings)
        return f"<p>{escape(repr(self))}</p>" + f"<ul>{warnings}</ul>" * bool(warnings)

    @property
    def supported(self) -> bool:
        """Return True without a reason against the calibration: ``--strict`` demands it.

        The error expected elsewhere is not large against the noise, and the headings have no wide gap.
        """
        return not self.calibration.warnings

    @property
    def scales(self) -> tuple[float, float]:
        """Smallest and largest scale of A at the samples: a fit can reduce its residual by shrinking them."""
        # 1,000 samples show the range of the scales over the positions
        step = max(len(self.samples.phi) // 1000, 1)
        scales, _ = scales_and_offsets(
            self.samples.part(slice(None, None, step)), self.calibration.without_effects().coefficients
        )
        return float(scales.min()), float(scales.max())

    @property
    def rms(self) -> float:
        """RMS of the residual, nT."""
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
    """Return the fit: its numbers as a calibration with a table of runs, and its residuals.

    `left_out`: what the fit is worth on parts left out: the sigmas grow by its ratio. `informative`: keep
    what the data alone say of the coefficients, without the prior.
    """
    # sigma and covariance grow by the ratio of held-out errors to claimed ones
    e, samples, noise, covariance = found.residual, found.samples, found.noise, found.covariance
    information = _without_prior(found) if informative else None
    if left_out is not None:
        information = information and information.divided(left_out.ratio)
        noise, covariance = replace(noise, sigma=noise.sigma * left_out.ratio), covariance * left_out.ratio**2
        details = {**(details or {}), "left_out_nT": left_out.rms, "left_out_ratio": left_out.ratio}
    steps = np.diff(data.time)
    calibration = Calibration(
        parameters=posed.ranges,
        terms=(Polynomial(exponents=posed.exponents),),
        coefficients=found.coefficients,
        covariance=covariance,
        noise=Noise(
            noise.sigma,
            samples.kappa * noise.sigma,
            noise.autocorrelation,
            float(np.median(steps)) if steps.size else 0.0,
            noise.white,
        ),
        reference=Reference(samples.F_0, data.model),
        sensor=CalibratedSensor(data.sensor, filter_cutoff=data.filter_cutoff),
        runs=_runs(data, e),
        method=method,
        inputs=dict(data.inputs),
        software=f"magbridge {__version__}",
    )
    return Fit(calibration, e, (), details or {}, samples, information=information)


def _without_prior(found: CoefficientPosterior) -> GaussianInformation:
    """Return the information of the data alone, from the posterior and its prior."""
    # information of the data = posterior's minus the prior's
    prior, coefficients = found.prior, found.coefficients
    before = prior.E @ np.linalg.inv(prior.precision) @ prior.E.T
    centre = np.broadcast_to(prior.offset, coefficients.shape)
    return GaussianInformation.from_posterior(coefficients, found.covariance, centre, before)


def _runs(data: Observations, e: FloatArray) -> tuple[Run, ...]:
    """Return each run's samples, RMS residual (nT) and mean positions."""
    labels, which = np.unique(data.runs, return_inverse=True)
    count = np.bincount(which)
    squares = np.bincount(which, e * e)
    places = [np.bincount(which, column) / count for column in data.parameters.T]
    return tuple(
        Run(str(label), int(n), float(np.sqrt(square / n)), tuple(map(float, place)))
        for label, n, square, *place in zip(labels, count, squares, *places, strict=True)
    )
