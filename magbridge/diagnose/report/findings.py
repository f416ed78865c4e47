"""``findings.json``: the findings for other programs. Its names are public."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from magbridge.arrays import plain
from magbridge.diagnose.alternatives import CompetingHypothesis
from magbridge.diagnose.assessment import Assessment, Note, telemetry_delay
from magbridge.diagnose.causes import Cause
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.joint import CONFIDENCE_LEVEL, Improvement, normal
from magbridge.diagnose.observed import Seen

__all__ = ["FINDINGS_FORMAT", "findings", "findings_json", "parameters"]

FINDINGS_FORMAT = 3
"""Of ``findings.json``, as ``docs/findings.schema.json`` describes it; raised when a name changes."""


def findings(
    diagnosis: Diagnosis, causes: Mapping[str, Cause], remarks: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what ``findings.json`` holds, as plain Python; a reader must know `remarks` of the logs."""
    listed = [_finding(diagnosis, finding, causes) for finding in diagnosis.findings]
    if diagnosis.wrong is not None:
        listed.append(_wrong(diagnosis))
    rest = diagnosis.unexplained
    return {
        "format": FINDINGS_FORMAT,
        "verdict": diagnosis.verdict,
        "rms_before_nT": _round(diagnosis.improvement.before),
        "rms_after_nT": _round(diagnosis.improvement.after),
        "improvement": _corrected(diagnosis),
        "findings": listed,
        "unexplained": None
        if rest is None
        else {
            "kind": rest.kind,
            "signal_to_noise": _round(rest.signal_to_noise),
            "period_s": None if rest.period_s is None else _round(rest.period_s),
            "best_channel": rest.best_channel or diagnosis.assessment.follows.channel,
            "follows": follows(diagnosis.assessment.follows),
            "correlation_time_s": _round(diagnosis.assessment.residual.correlation_time),
            "rms_nT": None if rest.size is None else _round(rest.size),
            "alternatives": alternatives(rest.within),
        },
        "assessment": assessment(diagnosis.assessment),
        "remarks": list(remarks),
    }


def findings_json(diagnosis: Diagnosis, causes: Mapping[str, Cause], remarks: Sequence[str] = ()) -> bytes:
    """Return ``findings.json``."""
    return (
        msgspec.json.format(
            msgspec.json.encode(findings(diagnosis, causes, remarks), enc_hook=plain), indent=2
        )
        + b"\n"
    )


def _finding(diagnosis: Diagnosis, finding: Finding, causes: Mapping[str, Cause]) -> dict[str, Any]:
    candidate, competing = finding.candidate, finding.competing
    return {
        "cause": candidate.cause,
        "channel": candidate.channel,
        "follows": follows(finding.follows(diagnosis.problem, diagnosis.fit)),
        "signal_to_noise": _round(finding.signal_to_noise),
        "p_value": _round(finding.hypothesis.p_value),
        "alternatives": alternatives(competing),
        "disambiguation": causes[candidate.cause].disambiguation if competing else None,
        "parameters": parameters(finding, len(diagnosis.problem)),
        "configuration": _configuration(diagnosis, finding),
        "improvement": _improvement(finding.improvement, diagnosis),
    }


def _configuration(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any] | None:
    """Return the keys of ``bridge.toml`` that correct for a finding; None where no key does."""
    late = telemetry_delay(diagnosis, finding)
    if late is None or late.delay_s <= 0.0 or late.after_nt >= late.before_nt:
        return None
    delay = {"delay": _round(late.delay_s)}
    return {"telemetry": {parameter.name: delay for parameter in diagnosis.problem.calibration.parameters}}


def alternatives(competing: tuple[CompetingHypothesis, ...]) -> list[dict[str, Any]]:
    """List the others within 20:1, the likeliest first."""
    return [{"cause": one.candidate.cause, "channel": one.candidate.channel} for one in competing]


def parameters(finding: Finding, samples: int) -> dict[str, dict[str, Any]]:
    """Value, sigma and unit of every coefficient, and of the nonlinear parameters.

    Where one channel acts with several lags, or an offset jumps more than once, the sum is given and its
    parts next to it. Coefficients with one common size are summed up as the RMS of their effect over the
    log's `samples`.
    """
    candidate = finding.candidate
    if candidate.spectra is not None:
        return {"rms": _rms(finding, samples)}
    covariance = finding.covariance * np.outer(candidate.width, candidate.width)
    value = finding.coefficients * candidate.width
    parts: dict[str, list[int]] = {}
    for k, name in enumerate(candidate.names):
        parts.setdefault(name.partition(" (")[0] if _adds_up(candidate) else name, []).append(k)
    found: dict[str, dict[str, Any]] = {}
    for name, members in parts.items():
        listed = {f"{name} ({i})": [k] for i, k in enumerate(members, 1)} if len(members) > 1 else {}
        for label, some in ({name: members} | listed).items():
            sigma = float(np.sqrt(covariance[np.ix_(some, some)].sum()))
            found[label] = {
                "value": _round(float(value[some].sum())),
                "sigma": _round(sigma),
                "unit": candidate.units[members[0]],
            }
    shape = {
        name: {"value": float(v), "sigma": None, "unit": unit}
        for name, (v, unit) in candidate.point.shape.items()
    }
    return found | shape


def _rms(finding: Finding, samples: int) -> dict[str, Any]:
    """RMS over the log of ``X b``, nT, and its sigma.

    ``f = sqrt(b^T M b)``, ``M = X^T X / n``, ``df/db = M b / f``.
    """
    b = finding.coefficients
    M = normal(finding.candidate.columns, np.zeros(samples))[0] / samples
    f = float(np.sqrt(b @ M @ b))
    slope = M @ b / max(f, 1e-12)
    sigma = float(np.sqrt(slope @ finding.covariance @ slope))
    return {"value": _round(f), "sigma": _round(sigma), "unit": "nT"}


def _adds_up(candidate: Candidate) -> bool:
    """Return True if coefficients of one name add up: those of one channel at several lags or onsets."""
    channels = {getattr(effect, "channel", None) for effect in candidate.effects}
    return len(channels) == 1 and not candidate.point.shape.keys().isdisjoint(("lag", "onset"))


def assessment(found: Assessment) -> dict[str, Any]:
    """Return the parts of the report in addition to the findings, rounded."""
    delays, budget, residual, track = found.delays, found.budget, found.residual, found.returns
    return {
        "fit_for_use": found.fit_for_use,
        "reason": found.reason,
        "condition": found.condition or None,
        "summary": found.summary,
        "reasons_for": _notes(found.reasons_for),
        "reasons_against": _notes(found.reasons_against),
        "manoeuvres": list(found.manoeuvres),
        "warnings": [_notes(some) for some in found.notes],
        "reference_shift": found.reference_shift and {
            "shift_nT": _round(found.reference_shift.shift), "sigma_nT": _round(found.reference_shift.sigma),
        },
        "channel_delays": delays and {
            "y_s": _round(delays.later[0]), "z_s": _round(delays.later[1]),
            "y_sigma_s": _round(delays.sigma[0]), "z_sigma_s": _round(delays.sigma[1]),
            "rms_nT": _round(delays.rms),
        },
        "rms_nT": {name: None if x is None else _round(x) for name, x in budget._asdict().items()},
        "residual": {
            "rms_nT": _round(residual.rms), "white_nT": _round(residual.white),
            "correlation_time_s": _round(residual.correlation_time), "slow_fraction": _round(residual.slow),
            "follows": follows(found.follows),
        },
        "spatial_temporal": track and {
            "distinguishable": track.distinguishable, "least_fraction": _round(track.separable),
            "returning_fraction": _round(track.share), "longest_s": _round(track.longest), "text": track.text,
        },
    }  # fmt: skip


def _notes(some: Sequence[Note]) -> list[dict[str, Any]]:
    numbers = [{name: _round(x) for name, x in note.numbers.items()} for note in some]
    return [
        {"code": note.code, "text": note.text, "numbers": given}
        for note, given in zip(some, numbers, strict=True)
    ]


def follows(what: Seen) -> dict[str, Any]:
    """Return the observed correlate, without its interpretation."""
    return {
        "channel": what.channel,
        "lag_s": what.lag,
        "axis": what.axis,
        "amplitude_nT": _round(what.size),
        "fraction": _round(what.share),
    }


def _wrong(diagnosis: Diagnosis) -> dict[str, Any]:
    wrong = diagnosis.wrong
    assert wrong is not None
    size = np.abs(diagnosis.residual[wrong.rows])
    return {
        "cause": "outliers",
        "channel": None,
        "follows": None,
        "signal_to_noise": _round(float(np.sqrt(wrong.ratio))),
        "p_value": _round(wrong.p_value),
        "alternatives": [],
        "disambiguation": None,
        "parameters": {
            "count": {"value": int(wrong.rows.size), "sigma": None, "unit": "1"},
            "median_amplitude": {"value": _round(float(np.median(size))), "sigma": None, "unit": "nT"},
        },
        "configuration": None,
        "improvement": None,
    }


def _improvement(improvement: Improvement, diagnosis: Diagnosis) -> dict[str, Any]:
    return {
        "rms_ratio": _round(improvement.ratio),
        "interval": [_round(improvement.interval[0]), _round(improvement.interval[1])],
        "level": CONFIDENCE_LEVEL,
        "held_out": diagnosis.problem.survey.parts,
    }


def _corrected(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the improvement of the corrected field, compared with a refit of the calibration alone."""
    found, over = diagnosis.improvement, diagnosis.over_refit
    day = diagnosis.other_day
    return _improvement(found, diagnosis) | {
        "before_nT": _round(found.before),
        "after_nT": _round(found.after),
        "refit_nT": _round(over.before),
        "ratio_to_refit": _round(over.ratio),
        "interval_to_refit": [_round(over.interval[0]), _round(over.interval[1])],
        "other_day": None if day is None else _improvement(day, diagnosis) | {"held_out": "days"},
    }


def _round(value: float) -> float:
    return float(f"{value:.5g}")
