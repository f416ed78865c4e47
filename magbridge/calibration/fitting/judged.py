"""What can be said against a fit: what its data could not determine, and what it shows of them itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.boresight import find_boresight, magnetic_headings
from magbridge.calibration.fitting.crossings import rough_rock
from magbridge.calibration.fitting.identify import combinations, expected_ratio, heading_gap, warnings_for
from magbridge.calibration.fitting.level import apart_from_level
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.offset_terms import in_words
from magbridge.errors import CalibrationError
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.calibration.fitting.result import Fit

__all__ = ["judged"]

UNSUPPORTED = 5.0
"""Expected error over noise, above which the data do not support the fit."""
LIKELIER = 3.0
"""Nats by which one more order is likelier (20:1) where the one that was asked for is too low."""
WORSE = 1.25
"""Errors of parts left out over what a fit claims for them, from which on a pilot should know."""
MIN_SIGNAL_TO_NOISE = 3.0
"""Standard deviation of the field along the sensor axis with the least variation, over the noise. Below it,
noise is more than a tenth of the variance there: a fit takes noise for attitudes (errors in variables of
second order), and 6,000 samples of 1,500 nT noise gave an ideal compass an offset of 13,900 nT at nine
sigmas."""
GAIN = 0.08
"""Departure of the middle scale from 1 that few sensors have, four sigmas of the prior: a wrong reference
shrinks all scales, and a real flight was off by as much that had met rock (0.88 to 0.94)."""
LASTING = 0.98
"""Autocorrelation of neighbours that no sensor's noise has beside a field in place."""
UNSEEN = 270.0
"""deg, a gap in the headings: less than a quarter of the compass does not determine the rest."""


def judged(found: Fit, data: Observations) -> Fit:
    """Return the fit with its boresight, and with warnings of what the data could not determine."""
    whole, mismatch = found.calibration, []
    calibration = whole.without_effects()
    if whole.effects or found.creep:  # they have been taken off
        data = replace(data, field=found.samples.field)
    if calibration.boresight is None:
        try:
            calibration = replace(calibration, boresight=find_boresight(calibration, data))
        except CalibrationError as error:
            mismatch.append(str(error))
            data = replace(data, attitude=None)
        if magnetic := magnetic_headings(calibration, data):
            mismatch.append(magnetic)
    ratio = expected_ratio(apart_from_level(calibration), data)
    lasting = found.details.get("autocorrelation", 0.0)
    noise = calibration.noise.sensor
    warnings = (
        *_warnings(ratio, noise, heading_gap(data), lasting),
        *_noise_for_attitudes(found.samples.field, noise),
        *rough_rock(data, found.details.get("rock"), noise),
    )
    if ratio > UNSUPPORTED:
        warnings = (*warnings, *found.open)
    unsupported = [f"the data do not support this fit: {'; '.join(warnings)}"] if warnings else []
    seen = combinations(found.samples, calibration.coefficients, max(noise, 1e-9))
    return replace(
        found,
        calibration=replace(whole, boresight=calibration.boresight, warnings=warnings),
        warnings=(
            *unsupported,
            *(found.open if ratio <= UNSUPPORTED else ()),
            *warnings_for(calibration, data),
            *mismatch,
            *_suspicions(found),
        ),
        details={
            **found.details,
            "expected_over_noise": ratio,
            "rank": seen.rank,
            "combinations_nT": seen.sigma.tolist(),
        },
    )


def _warnings(ratio: float, noise: float, gap: float, lasting: float) -> Iterator[str]:
    """Say why data do not support a fit: error over `noise` (nT), widest gap of the headings (deg), memory.

    `lasting` is the residual's autocorrelation where rock has been taken out of it.
    """
    if lasting > LASTING:
        yield (
            f"residuals of {noise:.0f} nT last for many samples (autocorrelation {lasting:.3f}) though the "
            "rock is taken out: two vehicles in one log, an offset that jumped, or wrong positions"
        )
    if ratio > UNSUPPORTED:
        yield (
            "at these pitches and positions, on any heading and with 10 degrees more roll, expect "
            f"{ratio * noise:.0f} nT of error"
        )
    if gap > UNSEEN:
        yield (
            f"all headings lie within {360.0 - gap:.0f} degrees, and on other headings the vehicle's field "
            "cannot be told from the Earth's"
        )


def _noise_for_attitudes(field: FloatArray, noise: float) -> Iterator[str]:
    """Report if the sensor's noise (nT) is not small against the variation of the field (n, 3), nT."""
    least = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(field.T))[0], 0.0)))
    if least < MIN_SIGNAL_TO_NOISE * noise:
        yield (
            f"the noise of {noise:.0f} nT is not small against the variation of the field along one axis "
            f"({least:.0f} nT), so that noise passes for attitudes: average readings, or turn further"
        )


def _suspicions(found: Fit) -> Iterator[str]:
    """Say what the fit itself shows to be wrong with the samples or with their reference."""
    samples, outliers = len(found.residual), found.details.get("outliers", 0)
    if outliers > 0.02 * samples:
        yield f"{outliers} of {samples} samples are outliers and were left out of the fit"
    yield from in_words(found.calibration, found.creep)
    if ends := found.details.get("ends", 0):
        yield (f"{counted(ends, 'sample')} at the ends of the log left out: unlike the others (a crash?)")
    if (ratio := found.details.get("left_out_ratio", 1.0)) > WORSE:
        yield (
            f"parts left out of the fit are off by {ratio:.1f} times what it claimed, so its sigmas were "
            "raised by that: the model lacks something (magbridge diagnose), or the reference does"
        )
    if (gained := found.details.get("next_order", 0.0)) > LIKELIER:
        yield (
            f"--order is too low: one more is likelier by {gained:.0f} nats, and the sigmas do not know what "
            "is missing"
        )
    smallest, largest = found.scales
    if abs(0.5 * (smallest + largest) - 1.0) > GAIN:
        yield (
            f"the fit multiplies the readings by {smallest:.2f} to {largest:.2f}, and anomalies with them: "
            "unless the sensor is that far off, the reference is; fit to runs at one place, or with a better "
            "map (--grid)"
        )
