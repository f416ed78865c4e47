"""Define the commands ``fleet``: catalogue logs of many vehicles, process them, and show changes."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import DataError, WrongUse
from magbridge.progress import track, waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.fleet.learn import History

ABOUT = "Many vehicles, many logs, one memory: catalogue, process, learn from them, watch them."
fleet = App(name="fleet", help=ABOUT, help_format="markdown")
cli.app.command(fleet)
Where = Annotated[str, Parameter(help="The catalogue: a folder, or postgresql://USER@HOST/DATABASE.")]
HERE = "fleet"


@fleet.command(usage="Usage: magbridge fleet add FILE... [--vehicle NAME --deployment NAME] [OPTIONS]")
def add(
    *files: Path,
    vehicle: str = "",
    deployment: str = "",
    refit: str = "",
    parameter: tuple[str, ...] = (),
    serial: str = "",
    sensor: str = "",
    date: cli.Day = None,
    catalogue: Where = HERE,
    json: cli.Json = False,
) -> None:
    """Add vehicles and logs to a catalogue, which is created if missing; repeated additions do nothing.

    Parameters
    ----------
    files
        A fleet.toml with vehicles, deployments and patterns of logs; or the logs of one deployment; or a
        calibration of one deployment that was made elsewhere (cal.json).
    vehicle
        Name of the logs' vehicle. With --parameter, the vehicle is added.
    deployment
        Name of the logs' deployment; a vehicle may have several deployments.
    refit
        Name of the vehicle's refit in the deployment. By default each deployment is a new refit.
    parameter
        A column with the position of one of the vehicle's masses; may be repeated.
    serial
        The vehicle's serial number, which distinguishes two vehicles of one name.
    sensor
        The vehicle's sensor; logs of other sensors are rejected. Without --parameter: the sensor of this
        deployment only.
    date
        Start of the deployment of a given calibration (YYYY-MM-DD).
    """
    from magbridge.fleet.catalogue import open_catalogue
    from magbridge.fleet.memory import add_calibration
    from magbridge.fleet.register import Deployment, Vehicle, add_logs, add_vehicle, logs_of, read_fleet

    if not files and not (vehicle and parameter):
        raise WrongUse("expected FILE (a fleet.toml or logs), or --vehicle NAME with its --parameter")
    described, made, logs = _sorted(files)
    if (logs or made) and not (vehicle and deployment):
        raise WrongUse("logs: expected --vehicle and --deployment with them, or a fleet.toml that lists them")
    if logs:
        cli.logs_to_read(tuple(logs))
    if made and date is None:
        raise WrongUse(f"{made[0]}: expected --date YYYY-MM-DD, the day on which its deployment began")
    plans = {file: read_fleet(file) for file in described}
    calibrations = [mb.load(file) for file in made]
    start = dt.datetime.combine(date, dt.time(), dt.UTC).timestamp() if date else 0.0
    there = open_catalogue(catalogue, create=True)
    added, new, given, lines = 0, 0, 0, list[str]()
    if vehicle and (parameter or serial):
        added += add_vehicle(there, vehicle, Vehicle(parameters=parameter, serial=serial, sensor=sensor))
    with waiting("reading"):
        this = Deployment(deployment, (), refit, "" if parameter else sensor)
        parts = [(vehicle, this, logs)] if logs else []
        for file, named in plans.items():
            for name, one in named.items():
                added += add_vehicle(there, name, one)
                parts += [(name, part, logs_of(file, part)) for part in one.deployment]
        for name, part, paths in parts:
            count, notes = add_logs(there, name, part, paths)
            new, lines = new + count, lines + notes
        for calibration in calibrations:
            given += add_calibration(there, vehicle, this, start, calibration)
    cli.complain_all(lines)
    facts = {"catalogue": there.name, "vehicles": added, "logs": new, "calibrations": given, "remarks": lines}
    text = f"{counted(added, 'vehicle')}, {counted(new, 'log')} and {counted(given, 'calibration')} added"
    cli.print_result(facts, f"{there.name}: {text}", json)


def _sorted(files: Sequence[Path]) -> tuple[list[Path], list[Path], list[Path]]:
    """Return three lists of files by suffix: fleet.toml (.toml), calibrations (.json), and logs."""
    kinds: dict[str, list[Path]] = {".toml": [], ".json": [], "": []}
    for file in files:
        kinds.get(file.suffix.lower(), kinds[""]).append(file)
    return kinds[".toml"], kinds[".json"], kinds[""]


@fleet.command
def process(
    *,
    catalogue: Where = HERE,
    results: Path | None = None,
    diagnose: bool = False,
    maps: bool = False,
    retry: bool = False,
    workers: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=1, lte=1024))] = 2,
    memory: str = "4 GiB",
    scheduler: str = "",
    json: cli.Json = False,
) -> None:
    """Read, check, calibrate and correct new logs; a new call continues after an interruption.

    The logs of a deployment are calibrated together, as calibrate does. An error in one log is printed, and
    the other logs are processed.

    Parameters
    ----------
    results
        Folder for corrected logs and maps; by default results in the catalogue's folder, or fleet-results in
        the working directory for a catalogue on a server.
    diagnose
        Also diagnose each deployment.
    maps
        Also make each deployment's anomaly map.
    retry
        Also process deployments again that had failures.
    workers
        Number of processes on this machine.
    memory
        Memory that each process may use, such as "4 GiB".
    scheduler
        Address of a dask scheduler to use instead of local processes, such as tcp://host:8786. Its workers
        must have access to the same folders.
    """
    from magbridge.fleet.catalogue import open_catalogue
    from magbridge.fleet.memory import remember
    from magbridge.fleet.process import client_of
    from magbridge.fleet.process import process as run
    from magbridge.fleet.register import jobs, new_jobs

    there = open_catalogue(catalogue, results)
    every = jobs(there, diagnose=diagnose, maps=maps)
    todo = new_jobs(there, every, retry=retry)
    failures: list[str] = []
    if todo:
        with client_of(scheduler, workers, memory) as client:
            for lines in track(run(there, todo, client), "deployments", len(todo), in_lines=True):
                failures += lines
                cli.complain_all(lines)
        with waiting("learning"):
            remember(there)
    result = {"deployments": len(every), "processed": len(todo), "failures": failures}
    text = f"{counted(len(every), 'deployment')}, {len(todo)} new; {counted(len(failures), 'failure')}"
    cli.print_result(result, f"{there.name}: {text}", json)
    if todo and len(failures) >= len(todo) and not there.rows("calibrations", ["job"]):
        raise cli.FailedResult(f"{there.name}: none of {len(todo)} deployments can be calibrated; see above")


@fleet.command
def status(*, catalogue: Where = HERE, json: cli.Json = False) -> None:
    """Print the numbers of catalogued, calibrated, failed and new logs of each vehicle, and the failures."""
    from magbridge.fleet.catalogue import open_catalogue
    from magbridge.fleet.register import status as of

    there = open_catalogue(catalogue)
    found = of(there)
    cli.complain_all(found["failures"])
    rows = [
        f"  {one['vehicle']}: {counted(one['deployments'], 'deployment')}, {counted(one['logs'], 'log')}, "
        f"{one['calibrated']} calibrated, {one['failed']} failed, {one['new']} new"
        for one in found["vehicles"]
    ]
    title = f"{there.name}: {counted(len(rows), 'vehicle')}"
    cli.print_result(found, "\n".join([title, *rows]), json)


@fleet.command
def show(
    vehicle: str = "", /, *, catalogue: Where = HERE, html: Path | None = None, json: cli.Json = False
) -> None:
    """Print the changes of a vehicle's coefficients from deployment to deployment.

    Parameters
    ----------
    vehicle
        Name of the vehicle; by default all vehicles.
    html
        Pages with charts to write: a file (.html) with all vehicles, or a folder with a page for each vehicle
        and all numbers as fleet.json.
    """
    from magbridge.fleet.catalogue import open_catalogue
    from magbridge.fleet.learn import history
    from magbridge.fleet.memory import findings, fleets, last_maps
    from magbridge.fleet.register import vehicles

    there = open_catalogue(catalogue)
    names = [vehicle] if vehicle else list(vehicles(there))
    found: dict[str, History] = {}
    with waiting("learning"):
        for name, learnt in fleets(there, names).items():
            if isinstance(learnt, DataError):
                cli.complain(f"{name}: {learnt}")
            else:
                found[name] = history(learnt, name)
    if not found:
        raise DataError(f"{there.name}: no deployment has been calibrated; run magbridge fleet process")
    if html:
        from magbridge.fleet.page import write_pages

        write_pages(found, html, findings(there), last_maps(there))
    facts_of = {name: one.facts for name, one in found.items()}
    cli.print_result({"vehicles": facts_of}, "\n".join(_lines(facts_of)), json)


@fleet.command
def export(
    vehicle: str,
    /,
    *,
    output: cli.CalibrationOutput,
    refit: str = "",
    catalogue: Where = HERE,
    json: cli.Json = False,
) -> None:
    """Write the predicted calibration of a vehicle's next deployment, before its calibration runs.

    Parameters
    ----------
    vehicle
        Name of the vehicle.
    output
        The calibration to write (cal.json).
    refit
        Name of the vehicle's refit in that deployment; by default a new refit.
    """
    from magbridge.fleet.catalogue import open_catalogue
    from magbridge.fleet.memory import fleet_of, unflown

    with waiting("learning"):
        learnt = fleet_of(open_catalogue(catalogue), vehicle)
        calibration = unflown(learnt, vehicle, refit)
    mb.save(calibration, output)
    count = sum(one.vehicle == vehicle for one in learnt.lessons)
    others = len(learnt.lessons) - count
    text = f"as {counted(count, 'deployment')} of {vehicle} and {others} of its fleet predict"
    cli.print_result({"vehicle": vehicle, "deployments": count}, text, json, output)


def _lines(facts_of: dict[str, dict[str, Any]]) -> list[str]:
    """Return a line for each vehicle, each change of its coefficients, and each omitted deployment."""
    lines = []
    for name, one in facts_of.items():
        parts = one["deployments"]
        changes = [(part, change) for part in parts for change in part["changes"]]
        lines.append(f"{name}: {counted(len(parts), 'deployment')}, {counted(len(changes), 'change')}")
        lines += [
            f"  {part['date']} {part['deployment']} (refit {part['refit']}): {change['what']} moved by "
            f"{change['by_nT']:+.0f} nT, {change['sigmas']:.1f} sigma: {change['cause']}"
            for part, change in changes
        ]
        lines += [
            f"  {part['date']} {part['deployment']} differs from earlier ones: the fleet's model omits it"
            for part in parts
            if part["omitted"]
        ]
    return lines
