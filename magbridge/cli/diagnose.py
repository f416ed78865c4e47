"""Define the command ``diagnose``, which finds errors of the calibration model and their causes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.files import digest
from magbridge.progress import waiting

if TYPE_CHECKING:
    import xarray as xr

FILL_VALUES = (-9999.0, -99999.0)
"""Numbers that logs commonly use in place of an unknown value, in any unit."""
ITSELF = (
    "the calibration was fitted to this log and has absorbed part of its errors, so that the remaining part "
    "easily gets a wrong name, and nothing is held out; calibrate on separate calibration runs, with "
    "--filter-cutoff if the sensor has an anti-alias filter"
)


@cli.command("diagnose FILE... --calibration cal.json -o DIR [OPTIONS]")
def diagnose(
    *files: Path,
    calibration: Path,
    output: Annotated[cli.Folder, Parameter(name=["--output", "-o"])],
    training_logs: tuple[Path, ...] = (),
    grid: Path | None = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Find the errors of the calibration model and their causes, and test an extended calibration.

    The command writes three files. report.html states the causes, how certain they are, and if the extended
    calibration may be used. findings.json has the same content for programs. calibration.json is the extended
    calibration, for correct, run and replay.

    Parameters
    ----------
    files
        Logs that the calibration was not fitted to. The improvement is measured by leaving out each dive in
        turn, or each eighth of a log with fewer than four dives.
    calibration
        The calibration (cal.json).
    output
        The folder to write to.
    training_logs
        A log that the calibration was fitted to, to identify errors that appeared later; may be repeated.
    grid
        An anomaly grid to add to the IGRF, for logs without reference_field.
    """
    cli.logs_to_read(files, output / "calibration.json", calibration, grid)
    from magbridge.diagnose.report.findings import findings
    from magbridge.diagnose.run import diagnose as examine

    known = mb.load(calibration)
    with waiting("reading") as step:
        logs, combined = cli.read_apart(files, reading)
        own = [path for path in files if digest(path) in known.inputs.values()]
        own_logs = [log for path, log in zip(files, logs, strict=False) if path in own]
        if len(combined) < len(logs):
            logs, own_logs = combined, combined if own else []
        cli.note_losses(*(log.attrs for log in logs))
        cli.note_unused_grid(grid, *logs)
        remarks = cli.warnings_of(known, calibration)
        others = [path for path in training_logs if path not in files]
        remarks += [f"{path}: {ITSELF}" for path in own]
        remarks += [remark for log in logs for remark in _suspect(log)]
        cli.complain_all(remarks)
        training = [*own_logs, *(mb.read(path, options=reading.without_sensor_logs) for path in others)]
        anomalies = mb.read_grid(grid) if grid else None
        found = examine(
            logs, known, output, training_logs=training, grid=anomalies, progress=step, remarks=remarks
        )
    facts = findings(found, remarks)
    lines = summary(facts, "" if own else found.diagnosis.problem.survey.parts)
    cli.print_result(facts, f"{lines}\nreport: {output / 'report.html'}", json)


def summary(facts: dict[str, Any], parts: str) -> str:
    """Return the findings as lines: the verdict with RMS errors, the fitness for use, and each cause.

    Parameters
    ----------
    facts : dict
        Contents of ``findings.json``.
    parts : str
        Description of the parts that were held out to measure the RMS after extension; empty if none was.
    """
    from magbridge.diagnostics import number

    before, after = (number(facts[f"rms_{when}_nT"]) for when in ("before", "after"))
    use, improvement = facts["assessment"], facts["improvement"]
    low, high = improvement["interval"]
    if use["reason"] == "nothing_added":
        rms = f"{before} nT RMS" + ", not held out" * (not parts) + "; nothing is added to the calibration"
    else:
        rms = f"error of the corrected field {before} -> {after} nT RMS, "
        rms += f"on {parts} left out of the fit" if parts else "not held out"
        rms += f" ({low:.2f} to {high:.2f} times, 95 %)" + ": no improvement is shown" * (high >= 1.0)
        rms += f"; {number(improvement['refit_nT'])} nT by a refit of the calibration alone"
    verdict = "nothing needs explaining" if use["reason"] == "not_needed" else facts["verdict"]
    fit = f"fit for use: {use['fit_for_use']}. {use['summary']}"
    scalar = [one["text"] for one in facts["scalar"]]
    return "\n  ".join([f"{verdict}: {rms}", fit, *causes_of(facts), *scalar])


def causes_of(facts: dict[str, Any]) -> list[str]:
    """Return a line for each cause found, with its alternatives, and a line for the unexplained residual."""
    from magbridge.diagnose.observed import WHITE
    from magbridge.diagnostics import number

    causes = []
    warnings = [*facts["assessment"]["warnings"], []]  # none of outliers, which stand last
    for one, notes in zip(facts["findings"], warnings, strict=False):
        codes = {note["code"] for note in notes}
        walks = ["noise that wanders"] * ("random_walk" in codes)
        others = " or ".join([*map(_plain, one["alternatives"]), *walks])
        lines = f"{_plain(one)}, S/N {one['signal_to_noise']:.1f}{_followed(one['follows'])}"
        lines += "; no improvement is shown" * ("no_improvement" in codes)
        causes.append(lines + f"; or {others}" * bool(others))
    if rest := facts["unexplained"]:
        lines = f"left without a name: {rest['kind']}, S/N {rest['signal_to_noise']:.1f}"
        left = facts["assessment"]["residual"]
        own = f"{number(rest['rms_nT'])} of " if rest["rms_nT"] is not None else ""
        lines += f", {own}{number(left['rms_nT'])} nT RMS"
        lines += f", lasts {rest['correlation_time_s']:.3g} s" * (left["white_nT"] < WHITE * left["rms_nT"])
        within = ", ".join(map(_plain, rest["alternatives"]))
        causes.append(f"{lines}{_followed(rest['follows'])}" + f"; resembles {within}" * bool(within))
    return causes or ["no cause"]


def _followed(series: dict[str, Any] | None) -> str:
    """Return the text about the series that an effect is correlated with: channel, lag and axis."""
    if not series:
        return ""
    late = f" {series['lag_s']:g} s late" * bool(series["lag_s"])
    along = f" along {series['axis']}" * bool(series["axis"])
    return f", follows {series['channel']}{late}{along}" if series["channel"] else f",{along}" * bool(along)


def _plain(cause: dict[str, Any]) -> str:
    return f"{cause['cause']} ({cause['channel']})" if cause["channel"] else str(cause["cause"])


def _suspect(log: xr.Dataset) -> Iterator[str]:
    """Yield a warning for each column with isolated values that may be codes for an unknown value."""
    for name, column in log.data_vars.items():
        values = column.to_numpy()
        for nothing in FILL_VALUES:
            alone = values == nothing
            if alone.any() and not (values[~alone] < 0.1 * nothing).any():
                yield (
                    f"{log.attrs['source']}, column {str(name)!r}: {nothing:g} in {alone.sum()} of "
                    f"{len(values)} rows is read as a number; if it means 'not known', leave it empty, or "
                    f"write # fill_value = {nothing:g} above the CSV's header"
                )
