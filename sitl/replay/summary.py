"""A replay's result in words."""

from __future__ import annotations

from typing import Any

Result = dict[str, Any]
UNKNOWN = 50_000.0
"""Sigma of the total field from which on nothing is known, nT."""


def summary(result: Result) -> str:
    """Return a replay's result for people to read."""
    if "runs" in result:
        return "\n".join(_own_log(run) for run in result["runs"])
    first = (
        f"{result['samples']} samples, {result['span_s'] / 3600:.1f} h, through a pty and a socket in "
        f"{result['seconds']:.1f} s: {result['span_s'] / result['seconds']:,.0f} times real time"
    )
    lines = [first]
    if result["skipped"]:
        lines.append(f"in the log: {_counted(result['skipped'])}")
    if result.get("simulated_field"):
        lines.append("the log has no magnetometer: real telemetry, simulated field")
    if "calibration" in result:
        lines.append(f"calibration: {result['calibration']}")
    lines.append(f"flags: {_counted(result['flags'])}")
    if result["navigation"]:
        lines.append(f"position updates: {_counted(result['navigation'])}")
    lines.append("")
    lines.append(
        f"{'against the reference field, nT RMS':36} {'samples':>8} {'raw':>9} {'corrected':>10} {'sigma':>7}"
    )
    for part in result["parts"]:
        name = part["name"] + (" (held out)" if part["held_out"] else "")
        numbers = [part["raw_rms_nT"], part["corrected_rms_nT"], part["sigma_nT"]]
        cells = ["-" if number is None or number > UNKNOWN else f"{number:.1f}" for number in numbers]
        lines.append(f"{name:36} {part['samples']:8d} {cells[0]:>9} {cells[1]:>10} {cells[2]:>7}")
    return "\n".join(lines)


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.items()) or "none"


def _own_log(result: Result) -> str:
    if result["identical"]:
        verdict = "republished bit for bit"
    elif result["first_difference"] == result["bytes"] and result["beyond"]:
        verdict = (
            f"republished bit for bit to the end of the log, and {result['beyond']} bytes beyond it: "
            "the log is truncated, or the bridge sent less"
        )
    elif result["late_s"]:
        verdict = (
            f"republished, but not identical: the log begins {result['late_s']:.1f} s into the run, without "
            f"what the bridge knew by then; the total field is the same in {result['same_samples']} of "
            f"{result['samples']} samples"
        )
        if result["worst_nT"]:
            verdict += f", the others differ by up to {result['worst_nT']:.2g} nT"
    else:
        verdict = (
            f"republished, but not identical: the first difference is at byte {result['first_difference']}"
        )
    size = f"{result['messages']} messages ({result['bytes']} bytes)"
    lines = [f"{result['files'][0]}: {size} {verdict}, in {result['seconds']:.1f} s"]
    if not result["same_config"]:
        lines.append("the configuration is not the one the log was recorded with")
    if result["damages"]:
        lines.append(f"damaged places in the log, which were skipped: {result['damages']}")
    return "\n".join(lines)
