"""Processing of a survey from its logs to its map: correct, align a scalar sensor, level, grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray, IndexArray
from magbridge.calibration.fitting.crossings import (
    PLACE_LENGTH_FRACTION,
    courses,
    crossed,
    far_off,
    jumps,
    too_rough,
)
from magbridge.calibration.fitting.field_search import Choice
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS
from magbridge.diagnostics import Diagnostic
from magbridge.errors import CalibrationError, DataError
from magbridge.estimation.residual import robust_scale
from magbridge.field.reference import mean_sigma
from magbridge.survey.alignment import ScalarTerms, align
from magbridge.survey.gridding import Gridded, gridded
from magbridge.survey.read import corrected_by_others, from_vector, joined, scalar_rows
from magbridge.survey.samples import Crossovers, Samples, crossovers
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Result", "facts", "samples_of", "scalar_survey", "summary", "survey"]

DRAWN_TRACKS = 16
"""Number of random fields and position errors that estimate the effect of a track's jumps."""
CONTRADICTION, MIN_MISTIE_NT = 2.5, 0.5
"""Mis-ties after levelling above which a warning is given, as a multiple of the noise and in nT."""


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a survey: samples, gridded field, crossovers and warnings."""

    samples: Samples
    """Corrected samples, without those far from all others; `level_sigma` is that of the map."""
    gridded: Gridded
    found: Crossovers
    before: FloatArray
    after: FloatArray
    """`before`, `after`: mis-ties (m,), nT, before and after levelling."""
    residual: FloatArray
    """Residual (n,), nT, of every sample: its anomaly minus level and map."""
    warnings: tuple[Diagnostic, ...]
    scalar: ScalarTerms | None = None
    """Lag, lever arm and heading error of a scalar magnetometer; None for other surveys."""


def samples_of(logs: Sequence[xr.Dataset], calibrations: Sequence[Calibration]) -> Samples:
    """Return the samples of several logs; logs with a raw vector are corrected with a calibration.

    `calibrations` has one for all logs with a vector, or one for each in order. DataError: another number of
    calibrations. FormatError: a log without positions.
    """
    vectors = [set(CHANNELS) <= set(log) for log in logs]
    many = sum(vectors)
    if many and len(calibrations) not in (1, many):
        raise DataError(
            f"{many} logs with mag_x mag_y mag_z, and {len(calibrations)} calibrations: give one "
            "for all, or one for each log in order"
        )
    waiting = iter(calibrations if len(calibrations) == many else [*calibrations] * many)
    return joined(
        [
            from_vector(log, next(waiting)) if vector else corrected_by_others(log)
            for log, vector in zip(logs, vectors, strict=True)
        ]
    )


def survey(samples: Samples, start: Choice | None = None) -> Result:
    """Level and grid corrected samples; `start` is the field that a joint fit has found, if any.

    CalibrationError: the samples do not determine a map.
    """
    warnings = [*samples.left_out]
    # 1. Leave out samples far from all others. 2. Grid. 3. Compare lines at their crossings before and after.
    far = far_off(samples.place)
    if count := int(far.sum()):
        warnings.append(Diagnostic("far_position", {"samples": counted(count, "sample")}))
    samples = samples.part(~far)
    with threadpool_limits(1, "blas"):
        try:
            found, doubts = _gridded(samples, start)
        except np.linalg.LinAlgError as problem:
            left_out = "".join(f"; {reason.text}" for reason in samples.left_out)
            raise CalibrationError(
                f"the map's equations are singular to rounding ({problem}): survey fewer lines at once, or "
                f"thin the log{left_out}"
            ) from problem
    warnings += doubts
    # Levels and slow changes are about their mean over the survey, which is not that of all times.
    samples = replace(samples, level_sigma=hypot(samples.level_sigma, mean_sigma(found.levels)))
    ties = crossovers(samples)
    B = found.at_samples(samples)
    residual = samples.value - found.levels - B
    # Two passes at different depths read different fields: compare them at the map's depth.
    deeper = B - found.at_samples(replace(samples, depth=np.full(len(B), found.middle)))
    before = ties.misties(samples.value - deeper)
    after = ties.misties(samples.value - found.levels - deeper)
    if not len(before) and samples.line.any():
        warnings.append(Diagnostic("no_crossing_lines"))
    elif not samples.line.any() and not sum(
        crossed(*courses(samples.place), PLACE_LENGTH_FRACTION * found.field.length)
    ):
        warnings.append(Diagnostic("no_crossing_track"))
    left = robust_scale(after) if len(after) else 0.0
    if left > max(CONTRADICTION * found.sigma, MIN_MISTIE_NT):
        divided = "" if samples.line.any() else "; a column line gives each line a level of its own"
        values = {"misties_nT": left, "noise_nT": found.sigma, "divided": divided}
        warnings.append(Diagnostic("misties_remain", values))
    if found.size > found.sigma:
        warnings += too_rough(samples.place, found.field.length)
    if (out := int((~found.kept).sum())) > 0.02 * len(residual):
        warnings.append(Diagnostic("outliers", {"count": out, "samples": len(residual), "product": "map"}))
    return Result(samples, found, ties, before, after, residual, tuple(warnings))


def scalar_survey(
    logs: Sequence[xr.Dataset],
    column: str,
    names: Sequence[str] = (),
    calibrations: Sequence[Calibration] = (),
    *,
    lag: float | None = None,
    lever: tuple[float, float, float] | None = None,
) -> Result:
    """Align, level and grid the samples of a scalar magnetometer, the `column` (nT) of logs with positions.

    `calibrations` has none, one for all logs, or one for each. A calibration whose ``sensors`` hold `column`
    compensates the sensor; otherwise the effects of the telemetry channels `names` are fitted. `lag` is the
    delay of the reading after the position, s. `lever` is the sensor's place relative to the logged
    positions, m forward, starboard and down. Lag and horizontal lever arm are estimated if not given.

    FormatError: a column is missing. DataError: the reading is not in nT, or the number of calibrations is
    wrong. CalibrationError: the samples cannot be aligned or gridded.
    """
    rows = scalar_rows(logs, column, names, calibrations, lever)
    samples, terms = align(rows, lag=lag, lever_known=lever is not None)
    made = survey(samples, terms.field)
    doubts = [finding for finding in terms.findings if finding.code == "scalar.implausible_shift"]
    return replace(made, scalar=terms, warnings=(*made.warnings, *doubts))


def _gridded(samples: Samples, start: Choice | None) -> tuple[Gridded, list[Diagnostic]]:
    """Grid samples; if the track jumps, the sigma includes the effect of wrong positions, with a warning.

    Misplaced stretches contradict each other where they cross. Each stretch between jumps is therefore a line
    with its own level, and without time, so that the contradictions do not count as slow changes. If they
    agree there, the vehicle has moved farther than usual, for example in a pause of the log.
    """
    # A jump of the track cuts a line: places before and after it are wrong by different amounts.
    at = jumps(samples.place, samples.time)
    at = at[samples.line[at] == samples.line[at + 1]]
    if not len(at):
        return gridded(samples, start=start), []
    # Each stretch between jumps is a line of its own, without a time.
    first = np.diff(samples.line, prepend=samples.line[0]) != 0
    first[at + 1] = True
    apart = replace(samples, time=np.full(len(samples.time), np.nan), line=np.cumsum(first))
    found = gridded(apart)
    ties = crossovers(replace(apart, time=samples.time))
    between = apart.line[ties.first] != apart.line[ties.second]
    misties = ties.misties(apart.value - found.levels)[between]
    # More crossings than levels of stretches, with mis-ties as small as the noise: the positions are right.
    if len(misties) > apart.line[-1] + 1 and _rms(misties) < CONTRADICTION * found.sigma:
        return gridded(samples, start=start), []
    modes = np.hstack([samples.modes, _misplaced(apart, at, found)])
    values = {"step_m": float(np.linalg.norm(np.diff(samples.place, axis=0)[at], axis=1).max())}
    doubt = Diagnostic("doubtful_places", values | {"jumps": counted(len(at), "jump")})
    return gridded(replace(apart, modes=modes)), [doubt]


def _misplaced(samples: Samples, line_ends: IndexArray, found: Gridded) -> FloatArray:
    """Return r random errors (n, r), nT, of the samples, as jumps of the track at `line_ends` (m,) may cause.

    At a jump by d, the stretch before and the stretch after each have an error of position N(0, d²/2).
    Position errors and fields are drawn at random; the sum of the r squared errors is the variance.
    """
    # Monte Carlo: draw fields and position errors; the difference of the field is the error of a sample.
    rng, field = np.random.default_rng(0), found.posteriors[0].field
    stretch, steps = samples.line, samples.place[line_ends + 1] - samples.place[line_ends]
    here, drawn = field.basis(samples.place), []
    for w in found.posteriors[0].draw(rng, DRAWN_TRACKS).T:
        # Draw which side of each jump is wrong, and by how much, and evaluate the field there.
        off = np.zeros((stretch[-1] + 1, 2))
        for side in (line_ends, line_ends + 1):
            np.add.at(off, stretch[side], rng.normal(size=(len(line_ends), 1)) * steps / 2.0**0.5)
        drawn.append(field.basis(samples.place + off[stretch]) @ w - here @ w)
    rough = found.roughness.evaluate(samples.place)[:, None]
    return np.asarray(rough * np.stack(drawn, axis=1) / DRAWN_TRACKS**0.5)


def facts(result: Result, path: Path) -> dict[str, Any]:
    """Return the survey's results as plain values, to print as JSON."""
    found = result.gridded
    return {
        "file": str(path),
        "samples": len(result.samples.value),
        "lines": len(np.unique(result.samples.line)),
        "crossovers": len(result.before),
        "misties_before_nT": _rms(result.before),
        "misties_after_nT": _rms(result.after),
        "residual_nT": _rms(result.residual[found.kept]),
        "noise_nT": found.sigma,
        "crustal_field": {
            "amplitude_nT": found.size,
            "length_m": found.field.length,
            "smoothness": found.field.alpha - 1,
        },
        "depth_m": found.middle,
        "level_sigma_nT": result.samples.level_sigma,
        "warnings": [warning.text for warning in result.warnings],
        **({"scalar": result.scalar.facts()} if result.scalar else {}),
    }


def summary(result: Result) -> str:
    """Return the survey's main results as a sentence."""
    known = facts(result, Path())
    ties = (
        f"{counted(known['crossovers'], 'crossover')} {known['misties_before_nT']:.1f} nT RMS before "
        f"levelling and {known['misties_after_nT']:.1f} after"
        if known["crossovers"]
        else "no crossovers"
    )
    crust = known["crustal_field"]
    return (
        f"{known['samples']} samples on {counted(known['lines'], 'line')}, {ties}; crustal field of "
        f"{crust['amplitude_nT']:.0f} nT over {crust['length_m']:.0f} m, noise {known['noise_nT']:.2f} nT; "
        f"level known to {known['level_sigma_nT']:.1f} nT (1-sigma)"
        + (f"; {result.scalar.summary()}" if result.scalar else "")
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
