"""Define the command ``diagnose``, which finds errors of the calibration model and their causes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    output: cli.FolderOutput,
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
        apart, logs, errors = cli.read_apart(files, reading)
        for error in errors.values():
            raise error
        own = [path for path in apart if digest(path) in known.inputs.values()]
        own_logs = [apart[path] for path in own]
        if len(logs) < len(apart):
            own, own_logs = own[:1], logs if own else []
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


@cache
def _texts() -> Any:
    """Return the module of the template ``diagnose.txt``."""
    from jinja2 import Environment, PackageLoader

    from magbridge.diagnose.observed import WHITE
    from magbridge.diagnostics import number

    def plain(cause: dict[str, Any]) -> str:
        return f"{cause['cause']} ({cause['channel']})" if cause["channel"] else str(cause["cause"])

    engine = Environment(loader=PackageLoader("magbridge.cli", ""))  # noqa: S701 - text has nothing to escape
    engine.filters |= {"plain": plain, "number": number}
    engine.globals["WHITE"] = WHITE
    return engine.get_template("diagnose.txt").module


def summary(facts: dict[str, Any], parts: str) -> str:
    """Return the findings as lines: the verdict with RMS errors, the fitness for use, and each cause.

    Parameters
    ----------
    facts : dict
        Contents of ``findings.json``.
    parts : str
        Description of the parts that were held out to measure the RMS after extension; empty if none was.
    """
    return "\n  ".join(_texts().summary(facts, parts).splitlines())


def causes_of(facts: dict[str, Any]) -> list[str]:
    """Return a line for each cause found, with its alternatives, and a line for the unexplained residual."""
    return list(_texts().causes(facts).splitlines())


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
