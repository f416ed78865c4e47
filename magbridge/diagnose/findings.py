"""``findings.json``: what was found, for machines. Its names are public."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from magbridge.diagnose.search import Hypothesis, Rival

if TYPE_CHECKING:
    from magbridge.diagnose.causes import Cause
    from magbridge.diagnose.gain import Gain
    from magbridge.diagnose.run import Diagnosis

__all__ = ["findings", "findings_json", "parameters"]

LEVEL = 0.95


def findings(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> dict[str, Any]:
    """Return the contract's table as plain Python."""
    listed = []
    at = len(diagnosis.problem.centre)
    for hypothesis, rivals, gain in zip(diagnosis.named, diagnosis.rivals, diagnosis.gains, strict=True):
        candidate = hypothesis.candidate
        listed.append(
            {
                "cause": candidate.cause,
                "channel": candidate.channel,
                "signal_to_noise": _round(hypothesis.signal_to_noise),
                "p_value": _round(hypothesis.p_value),
                "alternatives": alternatives(rivals),
                "isolability": _round(told(diagnosis, hypothesis)),
                "separated_by": causes[candidate.cause].separated_by if rivals else None,
                "parameters": parameters(diagnosis, hypothesis, at),
                "gain": _gain(gain),
            }
        )
        at += candidate.size
    if diagnosis.wrong is not None:
        listed.append(_wrong(diagnosis))
    rest = diagnosis.unexplained
    return {
        "verdict": diagnosis.verdict,
        "rms_before_nT": _round(diagnosis.total.before),
        "rms_after_nT": _round(diagnosis.total.after),
        "gain": _gain(diagnosis.total),
        "findings": listed,
        "unexplained": None
        if rest is None
        else {
            "kind": rest.kind,
            "signal_to_noise": _round(rest.signal_to_noise),
            "period_s": None if rest.period_s is None else _round(rest.period_s),
            "best_channel": rest.best_channel,
        },
    }


def findings_json(diagnosis: Diagnosis, causes: Mapping[str, Cause]) -> bytes:
    """Return ``findings.json``."""
    return msgspec.json.format(msgspec.json.encode(findings(diagnosis, causes)), indent=2) + b"\n"


def alternatives(rivals: tuple[Rival, ...]) -> list[dict[str, Any]]:
    """List the others within 20:1, the likeliest first."""
    return [{"cause": rival.cause, "channel": rival.channel} for rival in rivals]


def parameters(diagnosis: Diagnosis, hypothesis: Hypothesis, at: int) -> dict[str, dict[str, Any]]:
    """Value, sigma and unit of every coefficient, from place `at` of the joint fit, and of the nonlinear ones."""
    candidate, q = hypothesis.candidate, len(diagnosis.problem.centre)
    rows = slice(at, at + candidate.size)
    sigma = np.sqrt(np.diag(diagnosis.fit.covariance)[rows]) * candidate.width
    value = diagnosis.fit.coefficients[at - q : at - q + candidate.size] * candidate.width
    linear = {
        name: {"value": _round(v), "sigma": _round(s), "unit": unit}
        for name, v, s, unit in zip(candidate.names, value, sigma, candidate.units, strict=True)
    }
    shape = {
        name: {"value": float(v), "sigma": None, "unit": unit} for name, (v, unit) in candidate.shape.items()
    }
    return linear | shape


def told(diagnosis: Diagnosis, hypothesis: Hypothesis) -> float:
    """Theory's chance that this cause, of this size and direction, is named alone in this log."""
    info, chosen = diagnosis.outcome.info, diagnosis.outcome.chosen
    k = next(i for i, one in enumerate(chosen) if one.candidate is hypothesis.candidate)
    first = len(info.score) - sum(one.candidate.size for one in chosen[k:])
    own = np.arange(first, first + hypothesis.candidate.size)
    b = hypothesis.fit.coefficients[-hypothesis.candidate.size :]
    return diagnosis.isolability.telling.chance(
        hypothesis.candidate.cause, own, b, hypothesis.signal_to_noise
    )


def _wrong(diagnosis: Diagnosis) -> dict[str, Any]:
    wrong = diagnosis.wrong
    assert wrong is not None
    size = np.abs(diagnosis.fit.left[wrong.rows])
    return {
        "cause": "outliers",
        "channel": None,
        "signal_to_noise": _round(float(np.sqrt(wrong.ratio))),
        "p_value": _round(wrong.p_value),
        "alternatives": [],
        "separated_by": None,
        "parameters": {
            "count": {"value": int(wrong.rows.size), "sigma": None, "unit": "1"},
            "median_size": {"value": _round(float(np.median(size))), "sigma": None, "unit": "nT"},
        },
        "gain": None,
    }


def _gain(gain: Gain) -> dict[str, Any]:
    return {
        "rms_ratio": _round(gain.ratio),
        "interval": [_round(gain.interval[0]), _round(gain.interval[1])],
        "level": LEVEL,
        "held_out": "dives",
    }


def _round(value: float) -> float:
    return float(f"{value:.5g}")
