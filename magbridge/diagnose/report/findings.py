"""``findings.json``: the findings for other programs. The names of its keys are public."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from magbridge.arrays import plain
from magbridge.diagnose.assessment import Assessment, DiagnosisResult, separation, telemetry_delay
from magbridge.diagnose.columns import Candidate
from magbridge.diagnose.diagnosis import Diagnosis, Finding
from magbridge.diagnose.joint import CONFIDENCE_LEVEL, Improvement, normal
from magbridge.diagnose.observed import Seen
from magbridge.diagnose.search import Outliers
from magbridge.diagnose.state import CompetingHypothesis
from magbridge.diagnostics import Diagnostic

FINDINGS_FORMAT = 3
"""Version of the format of ``findings.json`` (``docs/findings.schema.json``); it rises if a key changes."""


def findings(result: DiagnosisResult, remarks: Sequence[str] = ()) -> dict[str, Any]:
    """Return the content of ``findings.json`` as plain Python; `remarks` are sentences on the logs."""
    diagnosis, assessment = result
    listed = [_finding(diagnosis, finding) for finding in diagnosis.findings]
    if diagnosis.wrong is not None:
        listed.append(_wrong(diagnosis, diagnosis.wrong))
    facts = {
        "format": FINDINGS_FORMAT,
        "verdict": diagnosis.verdict,
        "rms_before_nT": diagnosis.improvement.before,
        "rms_after_nT": diagnosis.improvement.after,
        "improvement": _corrected(diagnosis),
        "findings": listed,
        "scalar": [_of_scalar(one) for one in diagnosis.scalars],
        "unexplained": _unexplained(diagnosis, assessment),
        "assessment": _assessment(assessment),
        "remarks": list(remarks),
    }
    rounded: dict[str, Any] = _round(facts)
    return rounded


def findings_json(result: DiagnosisResult, remarks: Sequence[str] = ()) -> bytes:
    """Return ``findings.json`` encoded; `remarks` are sentences on the logs."""
    content = msgspec.json.encode(findings(result, remarks), enc_hook=plain)
    return msgspec.json.format(content, indent=2) + b"\n"


def _finding(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any]:
    candidate, competing = finding.candidate, finding.competing
    return {
        "cause": candidate.cause,
        "channel": candidate.channel,
        "follows": _follows(finding.follows(diagnosis.problem, diagnosis.fit)),
        "signal_to_noise": finding.signal_to_noise,
        "p_value": finding.hypothesis.p_value,
        "alternatives": _alternatives(competing),
        "disambiguation": diagnosis.causes[candidate.cause].disambiguation if competing else None,
        "parameters": parameters(finding, len(diagnosis.problem)),
        "configuration": _configuration(diagnosis, finding),
        "improvement": _improvement(finding.improvement, diagnosis.problem.survey.parts),
    }


def _configuration(diagnosis: Diagnosis, finding: Finding) -> dict[str, Any] | None:
    """Return the keys of ``bridge.toml`` that correct a finding; None if no key corrects it."""
    late = telemetry_delay(diagnosis, finding)
    if late is None or late.delay_s <= 0.0 or late.after_nt >= late.before_nt:
        return None
    masses = diagnosis.problem.calibration.parameters
    return {"telemetry": {parameter.name: {"delay": late.delay_s} for parameter in masses}}


def _alternatives(competing: Sequence[CompetingHypothesis]) -> list[dict[str, Any]]:
    """Return cause and channel of each competing hypothesis."""
    return [{"cause": one.candidate.cause, "channel": one.candidate.channel} for one in competing]


def parameters(finding: Finding, samples: int) -> dict[str, dict[str, Any]]:
    """Return value, sigma and unit of each coefficient and nonlinear parameter of a finding, by name.

    If one channel acts with several lags, or an offset jumps more than once, the sum and its parts are
    returned. Coefficients of one common size are represented by the RMS of their effect over all `samples`.
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
            sigma, unit = float(np.sqrt(covariance[np.ix_(some, some)].sum())), candidate.units[members[0]]
            found[label] = {"value": float(value[some].sum()), "sigma": sigma, "unit": unit}
    for name, (shape, unit) in candidate.point.shape.items():
        found[name] = {"value": shape, "sigma": None, "unit": unit}
    return found


def _rms(finding: Finding, samples: int) -> dict[str, Any]:
    """Return the RMS ``f = sqrt(b^T M b)`` of the effect ``X b`` over the log, nT, and its sigma."""
    b = finding.coefficients
    # M = X^T X / n, summed in pieces; df/db = M b / f
    M = normal(finding.candidate.columns, np.zeros(samples))[0] / samples
    f = float(np.sqrt(b @ M @ b))
    slope = M @ b / max(f, 1e-12)
    return {"value": f, "sigma": float(np.sqrt(slope @ finding.covariance @ slope)), "unit": "nT"}


def _adds_up(candidate: Candidate) -> bool:
    """Return True if coefficients of one name add up, as for one channel with several lags or onsets."""
    channels = {getattr(effect, "channel", None) for effect in candidate.effects}
    return len(channels) == 1 and not candidate.point.shape.keys().isdisjoint(("lag", "onset"))


def _unexplained(diagnosis: Diagnosis, assessment: Assessment) -> dict[str, Any] | None:
    """Return the entry of the unexplained structure; None if there is none."""
    rest = diagnosis.unexplained
    return rest and {
        "kind": rest.kind,
        "signal_to_noise": rest.signal_to_noise,
        "period_s": rest.period_s,
        "best_channel": rest.best_channel or assessment.follows.channel,
        "follows": _follows(assessment.follows),
        "correlation_time_s": assessment.residual.correlation_time,
        "rms_nT": rest.size,
        "alternatives": _alternatives(rest.within),
    }


def _assessment(found: Assessment) -> dict[str, Any]:
    """Return the entry of the assessment: verdict, reasons and quantities."""
    delays, residual, track, shift = found.delays, found.residual, found.returns, found.reference_shift
    return {
        "fit_for_use": found.fit_for_use,
        "reason": found.reason,
        "condition": found.condition or None,
        "summary": found.summary,
        "reasons_for": _notes(found.reasons_for),
        "reasons_against": _notes(found.reasons_against),
        "manoeuvres": list(found.manoeuvres),
        "warnings": [_notes(some) for some in found.notes],
        "reference_shift": shift and {"shift_nT": shift.shift, "sigma_nT": shift.sigma},
        "channel_delays": delays and {
            "y_s": delays.later[0], "z_s": delays.later[1], "y_sigma_s": delays.sigma[0],
            "z_sigma_s": delays.sigma[1], "rms_nT": delays.rms,
        },
        "rms_nT": found.budget._asdict(),
        "residual": {
            "rms_nT": residual.rms, "white_nT": residual.white, "slow_fraction": residual.slow,
            "correlation_time_s": residual.correlation_time, "follows": _follows(found.follows),
        },
        "spatial_temporal": track and {
            "distinguishable": track.distinguishable, "least_fraction": track.separable,
            "returning_fraction": track.share, "longest_s": track.longest, "text": separation(track).text,
        },
    }  # fmt: skip


def _of_scalar(note: Diagnostic) -> dict[str, Any]:
    """Return the entry of a finding for a scalar sensor."""
    return {
        "column": note.values["column"],
        "cause": note.code.partition(".")[2],
        "channel": note.values.get("channel"),
        "text": note.text,
        "numbers": note.numbers,
    }


def _notes(notes: Sequence[Diagnostic]) -> list[dict[str, Any]]:
    return [{"code": note.code, "text": note.text, "numbers": note.numbers} for note in notes]


def _follows(seen: Seen) -> dict[str, Any]:
    """Return the entry of the series that a signal follows."""
    return dict(zip(("channel", "lag_s", "axis", "amplitude_nT", "fraction"), seen, strict=True))


def _wrong(diagnosis: Diagnosis, wrong: Outliers) -> dict[str, Any]:
    size = float(np.median(np.abs(diagnosis.residual[wrong.rows])))
    nothing = dict.fromkeys(("channel", "follows", "disambiguation", "configuration", "improvement"))
    return {
        "cause": "outliers",
        "signal_to_noise": float(np.sqrt(wrong.ratio)),
        "p_value": wrong.p_value,
        "alternatives": [],
        "parameters": {
            "count": {"value": int(wrong.rows.size), "sigma": None, "unit": "1"},
            "median_amplitude": {"value": size, "sigma": None, "unit": "nT"},
        },
        **nothing,
    }


def _improvement(improvement: Improvement, parts: str) -> dict[str, Any]:
    return {
        "rms_ratio": improvement.ratio, "interval": list(improvement.interval), "level": CONFIDENCE_LEVEL,
        "held_out": parts,
    }  # fmt: skip


def _corrected(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the entry of the corrected field's improvement over the given calibration and over a refit."""
    found, over, day = diagnosis.improvement, diagnosis.over_refit, diagnosis.other_day
    return _improvement(found, diagnosis.problem.survey.parts) | {
        "before_nT": found.before,
        "after_nT": found.after,
        "refit_nT": over.before,
        "ratio_to_refit": over.ratio,
        "interval_to_refit": list(over.interval),
        "other_day": day and _improvement(day, "days"),
    }


def _round(value: Any) -> Any:
    """Return plain data with its numbers rounded to five digits, except values without a sigma (an onset)."""
    if isinstance(value, dict):
        exact = value.get("sigma", 0.0) is None
        return value if exact else {name: _round(x) for name, x in value.items()}
    if isinstance(value, list):
        return [_round(x) for x in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value
