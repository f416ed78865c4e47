"""Check a fit: its boresight, and warnings about its data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.fitting.boresight import choose_boresight, magnetic_headings
from magbridge.calibration.fitting.crossings import too_rough
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import apart_from_level, expected_error, nearby_mission
from magbridge.calibration.model import Calibration
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError
from magbridge.estimation.residual import rms
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.calibration.fitting.result import Fit

# ---- What the data determine ----

MIN_POSITION_STEP_FRACTION = 0.02
"""Smallest distance between two positions of a mass, as a fraction of half its range, and smallest fraction
of the samples at a position that counts."""
SWEPT = 0.3
"""Width of a group of positions over half the range, above which the mass moved continuously."""
MAX_CORRELATION = 0.9
"""Correlation of two positions above which their effects cannot be distinguished."""
BANKED = 10.0
"""Smallest range of roll that determines the vertical offset, deg."""
DIVE_PITCH_DEG = 5.0
"""Smallest absolute pitch of a dive or climb, deg."""
OPEN = 60.0
"""Smallest gap in the headings that is reported, deg."""


def _positions(calibration: Calibration, data: Observations) -> Iterator[Diagnostic]:
    """Yield a warning for each mass with too few different positions for the order of the fit."""
    for k, parameter in enumerate(calibration.parameters):
        order = max((e[k] for term in calibration.terms for e in term.exponents), default=0)
        # group the positions: a gap in their sorted values separates two places
        column = np.sort(data.parameters[:, k])
        jumps = np.flatnonzero(np.diff(column) > MIN_POSITION_STEP_FRACTION * parameter.scale)
        groups = [g for g in np.split(column, jumps + 1) if len(g) > MIN_POSITION_STEP_FRACTION * len(column)]
        if any(np.ptp(g) > SWEPT * parameter.scale for g in groups):
            continue  # the mass moved continuously
        if len(groups) <= min(order, 3):
            places = " and ".join(f"{np.median(g):.4g}" for g in groups)
            values = {"parameter": parameter.name, "positions": counted(len(groups), "position")}
            yield Diagnostic("few_positions", values | {"places": f"{places} {parameter.unit}".rstrip()})


def _moved_together(calibration: Calibration, data: Observations) -> Iterator[Diagnostic]:
    """Yield a warning for each pair of masses with correlated positions."""
    names = [parameter.name for parameter in calibration.parameters]
    if len(names) < 2:
        return
    # correlated positions have collinear columns in the Jacobian
    together = np.atleast_2d(np.corrcoef(data.parameters[:, : len(names)].T))
    for i, one in enumerate(names):
        for j, other in enumerate(names[:i]):
            if abs(together[i, j]) > MAX_CORRELATION:
                values = {"one": other, "other": one, "correlation": float(together[i, j])}
                yield Diagnostic("moved_together", values)


def _attitudes(calibration: Calibration, data: Observations) -> Iterator[Diagnostic]:
    """Yield a warning for each range of roll, pitch or heading that the data lack."""
    if data.attitude is None:
        return
    known = data.attitude[np.isfinite(data.attitude).all(axis=1)]
    if not len(known):
        return
    roll, pitch, heading = np.degrees(known).T
    # roll separates the vertical offset from the vertical scale
    low, high = np.quantile(roll, [0.02, 0.98])
    variance = calibration.covariance[8, 8]  # of T's z
    if high - low < BANKED and variance > (5.0 * calibration.noise.sensor) ** 2:
        values = {"low": float(low), "high": float(high), "sigma_nT": float(np.sqrt(variance))}
        yield Diagnostic("narrow_roll", values)
    angles = {"low": float(pitch.min()), "high": float(pitch.max())}
    if pitch.min() > -DIVE_PITCH_DEG and pitch.max() < DIVE_PITCH_DEG:
        yield Diagnostic("narrow_pitch", angles)
    elif pitch.min() > -DIVE_PITCH_DEG or pitch.max() < DIVE_PITCH_DEG:
        seen, lacking = ("climbs", "dives") if pitch.min() > -DIVE_PITCH_DEG else ("dives", "climbs")
        yield Diagnostic("one_pitch_sign", {"seen": seen, "lacking": lacking, **angles})
    left, gap = _widest_gap(heading)
    if gap > OPEN:
        yield Diagnostic("heading_gap", {"left": left, "right": (left + gap) % 360.0})


def heading_gap(data: Observations) -> float:
    """Return the width of the widest gap between headings, deg; 0 if no heading is known."""
    if data.attitude is None:
        return 0.0
    heading = np.degrees(data.attitude[:, 2])
    known = np.isfinite(heading)
    return _widest_gap(heading[known])[1] if known.any() else 0.0


def _widest_gap(heading: FloatArray) -> tuple[float, float]:
    """Return the start and the width of the widest gap between headings (n,), deg."""
    # gaps on the circle, including the gap across north
    courses = np.sort(heading % 360.0)
    gaps = np.diff(np.append(courses, courses[0] + 360.0))
    widest = int(np.argmax(gaps))
    return float(courses[widest]), float(gaps[widest])


def _runs(calibration: Calibration, data: Observations) -> Iterator[Diagnostic]:
    """Yield a warning if a calibration with parameters has fewer than four runs."""
    count = len(np.unique(data.runs))
    if calibration.parameters and count < 4:
        yield Diagnostic("few_runs", {"runs": counted(count, "run")})


# ---- The checks of a whole fit ----

UNSUPPORTED = 5.0
"""Ratio of expected error and noise above which the data do not support the fit."""
MAX_ERROR_RATIO = 1.25
"""Ratio of held-out errors and their sigmas above which a warning is given."""
MIN_SIGNAL_TO_NOISE = 3.0
"""Smallest ratio of the field's standard deviation, along its least varied axis, and the noise. Below it, a
fit mistakes noise for attitudes (errors in variables of second order): with 6,000 samples of 1,500 nT noise,
an ideal compass got an offset of 13,900 nT, nine sigmas."""
GAIN = 0.08
"""Departure of the middle scale from 1 above which a warning is given: four sigmas of the prior. A wrong
reference shrinks all scales; over an unmapped crustal anomaly of a real flight they became 0.88 to 0.94."""
MAX_PRIOR_CHI_SQUARED = 27.9
"""Chi squared of the nine coefficients about their prior that one sensor in 1,000 exceeds."""
MAX_SCALE_SIGMA_RATIO = 0.25
"""Ratio of posterior and prior sigma of a scale above which the prior influences the scale. At 0.25 the prior
moves the scale by a sixteenth of its departure."""
MAX_NOISE_AUTOCORRELATION = 0.98
"""Autocorrelation of successive residuals of a survey fit above which they are not sensor noise."""
MAX_HEADING_GAP_DEG = 270.0
"""Largest gap in the headings with which the data support a fit, deg."""


def judged(found: Fit, data: Observations) -> Fit:
    """Return the fit with its boresight and with warnings about undetermined quantities."""
    # 1. boresight; 2. reasons against the fit, which `--strict` rejects; 3. further warnings
    whole = found.calibration
    mismatch: list[Diagnostic] = []
    calibration = whole.without_effects()
    if whole.effects or found.creep:  # the fit has subtracted them from its samples
        data = replace(data, field=found.samples.field)
    if calibration.boresight is None:
        try:
            calibration = replace(calibration, boresight=choose_boresight(calibration, data))
        except CalibrationError as error:
            mismatch.append(Diagnostic("no_boresight", {"reason": str(error)}))
            data = replace(data, attitude=None)
        if magnetic := magnetic_headings(calibration, data):
            mismatch.append(magnetic)
    # the level is common to all samples, and no manoeuvre reduces it: exclude it from the expected error
    noise, known = calibration.noise.sensor, apart_from_level(calibration)
    ratio = rms(expected_error(known, nearby_mission(known, data))) / max(noise, 1e-9)
    warnings = tuple(_reasons(found, data, ratio, noise))
    if ratio > UNSUPPORTED:
        warnings = (*warnings, *found.open)
    reasons = tuple(warning.text for warning in warnings)
    checks = _positions, _moved_together, _attitudes, _runs
    unsupported = [Diagnostic("unsupported_fit", {"reasons": "; ".join(reasons)})] if reasons else []
    return replace(
        found,
        calibration=replace(whole, boresight=calibration.boresight, warnings=reasons),
        warnings=(
            *unsupported,
            *(found.open if ratio <= UNSUPPORTED else ()),
            *(one for check in checks for one in check(calibration, data)),
            *mismatch,
            *_suspicions(found),
        ),
        details={**found.details, "expected_over_noise": ratio},
    )


def _reasons(found: Fit, data: Observations, ratio: float, noise: float) -> Iterator[Diagnostic]:
    """Yield reasons against a fit; `ratio`: expected error over the `noise` of a sample, nT."""
    # autocorrelation of the residual after the crustal field has been subtracted
    lasting = found.details.get("autocorrelation", 0.0)
    if lasting > MAX_NOISE_AUTOCORRELATION:
        yield Diagnostic("lasting_residual", {"noise_nT": noise, "autocorrelation": lasting})
    if ratio > UNSUPPORTED:
        yield Diagnostic("expected_error", {"error_nT": ratio * noise})
    if (gap := heading_gap(data)) > MAX_HEADING_GAP_DEG:
        yield Diagnostic("narrow_headings", {"width_deg": 360.0 - gap})
    # the noise must be small compared with the field's variation along any axis (errors in variables)
    least = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(found.samples.field.T))[0], 0.0)))
    if least < MIN_SIGNAL_TO_NOISE * noise:
        yield Diagnostic("noise_for_attitudes", {"noise_nT": noise, "variation_nT": least})
    crust = found.details.get("crustal_field")
    if crust and data.place is not None and crust["amplitude_nT"] > noise:
        yield from too_rough(data.place[:, :2], crust["length_m"], crust["shortest_m"])
    # unusual scales are a fault of the fit only if the attitudes do not determine them: if the data overrule
    # the prior, the sensor has an unusual gain
    unlikely = found.details.get("prior_chi_squared", 0.0) > MAX_PRIOR_CHI_SQUARED
    if unlikely and found.details["scale_sigma_ratio"] > MAX_SCALE_SIGMA_RATIO:
        low, high = found.scales
        yield Diagnostic("unusual_gain", {"low": low, "high": high})


def _suspicions(found: Fit) -> Iterator[Diagnostic]:
    """Yield warnings about the samples or their reference that follow from the fit."""
    samples, outliers = len(found.residual), found.details.get("outliers", 0)
    if outliers > 0.02 * samples:
        yield Diagnostic("outliers", {"count": outliers, "samples": samples, "product": "fit"})
    # quantities on which the offset depends
    for effect in found.calibration.effects:
        if isinstance(effect, ChannelEffect):
            slope = float(np.linalg.norm(found.calibration.coefficients[-effect.size :]))
            late = f", {effect.lag / 60:.0f} minutes late" if effect.lag else ""
            values = {"slope": slope, "late": late, "channel": effect.channel}
            yield Diagnostic("temperature_removed", values)
    if found.creep is not None:
        size = rms(np.linalg.norm(found.creep.offset, axis=1))
        yield Diagnostic("offset_crept", {"rms_nT": size})
    if ends := found.details.get("ends", 0):
        yield Diagnostic("ends_left_out", {"samples": counted(ends, "sample")})
    if (ratio := found.details.get("left_out_ratio", 1.0)) > MAX_ERROR_RATIO:
        yield Diagnostic("held_out_errors", {"ratio": ratio})
    smallest, largest = found.scales
    if abs(0.5 * (smallest + largest) - 1.0) > GAIN:
        yield Diagnostic("unusual_scales", {"low": smallest, "high": largest})
