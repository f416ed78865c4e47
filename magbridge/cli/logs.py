"""Define the commands that describe, convert and simulate logs, and that merge anomaly grids."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import WrongUse
from magbridge.progress import track, waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    from rich.table import Table


WIDE_TERMINAL = 110
"""Width of a terminal, characters, from which the table of columns includes their meanings."""
MAX_LISTED_LOGS = 3
"""Largest number of combined logs that the title lists by name."""


@cli.command("info FILE... [OPTIONS]")
def info(*files: Path, reading: cli.ReadingOptions = cli.AS_THEY_SAY, json: cli.Json = False) -> None:
    """Describe logs: columns, units, rates, gaps, ranges, and the commands that can use them.

    The command describes several logs one after the other. It also describes the combination of a sensor's
    own log with the vehicle's logs. An error in one of several logs is reported, and the command describes
    the others; its exit code is then 1.

    Parameters
    ----------
    files
        The logs.
    """
    if len(files) < 2:
        cli.logs_to_read(files)
    from magbridge.logs.deployment import join
    from magbridge.logs.info import info as facts_of

    with waiting("reading"):
        apart, combined, errors = cli.read_apart(files, reading)
        logs = {str(path): log for path, log in apart.items()}
        count = len(apart) + len(errors)
        for error in errors.values():
            if count == 1:
                raise error
            cli.complain(str(error))
        if len(combined) < len(logs):
            names = [Path(name).name for name in logs]
            listed = " and ".join(names) if len(names) <= MAX_LISTED_LOGS else f"{len(names)} logs"
            logs[f"{listed} together"] = join(combined)
    found: dict[str, dict[str, Any]] = {str(path): {"error": str(error)} for path, error in errors.items()}
    for name, log in logs.items():
        found[name] = facts_of(log)
        if not json:
            cli.note_losses(log.attrs)
            _show(name, found[name])
    cli.print_result(found, "", json)
    if errors:
        raise cli.FailedResult(f"{len(errors)} of {count} logs cannot be read; see the lines above")


def _show(file: str, facts: dict[str, Any]) -> None:
    from msgspec import convert
    from rich.console import Console
    from rich.text import Text

    from magbridge.logs.compasses import LogCompass

    console = Console(highlight=False, markup=False)  # a name may contain brackets
    console.print(Text.assemble((file, "bold"), f": {summary(facts)}"), soft_wrap=True)
    for compass in facts["compasses"]:
        one = convert(compass, LogCompass)
        console.print(f"  {one.words}{', read as mag_x mag_y mag_z' * one.chosen}")
    console.print(_columns(facts, meanings=console.width >= WIDE_TERMINAL))
    console.print(_uses(facts))
    cli.complain_all(f"{file}: {hint}" for hint in facts["hints"])


def summary(facts: dict[str, Any]) -> str:
    """Return a sentence with a log's number of rows, its time span, its rate and its gaps."""
    if not facts["rows"]:
        return "no rows"
    boot = facts["references"]["time_reference"] == "boot"
    first, last = (
        f"{facts[end]:.1f} s" if boot else f"{datetime.fromtimestamp(facts[end], UTC):%Y-%m-%d %H:%M:%S} UTC"
        for end in ("start", "end")
    )
    rate = f", {facts['rate_hz']:.4g} Hz" if facts["rate_hz"] else ""
    gaps = ""
    if facts["gaps"]:
        gaps = f", {counted(facts['gaps'], 'gap')}, the longest of {facts['longest_gap_s']:.4g} s"
    return f"{counted(facts['rows'], 'row')}, {first} to {last}{rate}{gaps}"


def _columns(facts: dict[str, Any], *, meanings: bool) -> Table:
    from magbridge.columns import CHANNEL_TIMES

    table = _table()
    for name in ("column", "unit"):
        table.add_column(name, overflow="fold")
    for name in ("known", "lowest", "highest", "changes every"):
        table.add_column(name, justify="right", no_wrap=True)
    if meanings:
        table.add_column("meaning")
    for one in facts["columns"]:
        every = one["changes_every_s"]
        ends = ("", "") if one["name"] in CHANNEL_TIMES else (one["lowest"], one["highest"])
        table.add_row(
            one["name"],
            "" if one["unit"] == "1" else one["unit"],
            f"{one['known']:.0%}",
            *(f"{end:.6g}" if isinstance(end, float) else "" for end in ends),
            "" if every is None else f"{every:.3g} s",
            *([one["meaning"]] if meanings and one["meaning"] != one["name"] else []),
        )
    return table


def _uses(facts: dict[str, Any]) -> Table:
    table = _table("command", "could use it?")
    for name, lacks in facts["uses"].items():
        table.add_row(name, f"lacks {'; and '.join(lacks)}" if lacks else "yes")
    return table


def _table(*names: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(*names, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)


@cli.command("convert FILE... -o FILE [OPTIONS]")
def convert(
    *files: Path,
    output: cli.Log,
    heading_reference: cli.Heading = None,
    metadata: Path | None = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Convert logs from any readable format to any writable one; several logs are merged in time order.

    Parameters
    ----------
    files
        The logs to convert.
    output
        The file to write; its suffix sets the format: .csv .magarrow.csv .mcap .nc .parquet .tlog .xyz.
    metadata
        A metadata.toml about people, platform and sensor, to write a netCDF in the format OceanGliders OG1.0.
    """
    cli.logs_to_read(files, output, metadata)
    if metadata and output.suffix.lower() != ".nc":
        raise WrongUse(f"--metadata: expected a netCDF (.nc) to write, got {output}")

    from magbridge.logs import Writer, og, read_chunks

    rows, pieces = 0, []
    complete = partial(og.complete, metadata=og.read_metadata(metadata)) if metadata else None
    with Writer(output, complete, og1=True) if complete else Writer(output) as writer:
        for part in track(read_chunks(files, options=reading.options), "reading"):
            pieces.append(part.attrs)
            if heading_reference:
                part.attrs["heading_reference"] = heading_reference
            writer.append(part)
            rows += part.sizes["time"]
            names = [str(name) for name in part.data_vars]
    cli.note_losses(*pieces)
    cli.print_result({"rows": rows, "columns": names}, counted(rows, "row"), json, output)


@cli.command("simulate SCENARIO -o FILE [OPTIONS]")
def simulate(
    scenario: Path,
    /,
    *,
    output: cli.Log,
    seed: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=0))] = 0,
    trajectory_from: tuple[Path, ...] = (),
    reference: Literal["none", "true", "map"] | None = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    map_output: Annotated[Path | None, Parameter(name="--map", validator=cli.file_to_write(".nc"))] = None,
    json: cli.Json = False,
) -> None:
    """Simulate the log of a deployment with the forward model of field, vehicle and sensor.

    Parameters
    ----------
    scenario
        A scenario file (.toml; docs/files.md lists its keys), or the name of a built-in scenario: demo,
        survey, bonne_bay or random_glider; comet or seaglider, which need --trajectory-from; turn_on,
        warming, bolt, pump or battery, in which the vehicle changes.
    output
        The file to write.
    seed
        Seed of the random numbers; the same scenario and seed give the same deployment.
    trajectory_from
        A log whose attitude, position and masses replace the scenario's mission; may be repeated. The logs of
        one call share the same simulated world.
    reference
        Content of reference_field, instead of the scenario's. none: the column is omitted; true: the true
        total field; map: the main field plus the anomaly of a simulated airborne survey.
    map_output
        A file (.nc) for the anomaly grid that an aeromagnetic survey of the simulated world would produce.
    """
    from magbridge.logs import write
    from sitl.scenario import load
    from sitl.twin import Twin, placed_at, simulate_like
    from sitl.twin import simulate as simulate_scenario

    cli.check_inputs((scenario, *trajectory_from), output)
    cli.check_inputs((scenario, *trajectory_from, output), map_output)
    if trajectory_from:
        cli.logs_to_read(trajectory_from)
    chosen = load(scenario)
    if reference is not None:
        telemetry = msgspec.structs.replace(chosen.telemetry, reference=reference)
        chosen = msgspec.structs.replace(chosen, telemetry=telemetry)
    log = None
    with waiting("simulating"):
        if trajectory_from:
            log = mb.read(trajectory_from, options=reading.options)
            cli.note_losses(log.attrs)
            chosen = placed_at(log, chosen)
        with cli.naming(scenario):
            deployment = simulate_like(log, chosen, seed) if log else simulate_scenario(chosen, seed)
    write(deployment, output)
    if map_output is not None:
        Twin.draw(chosen, seed).anomaly_map().save(map_output)
    rows = deployment.sizes["time"]
    cli.print_result({"rows": rows, "seed": seed}, counted(rows, "row"), json, output)


@cli.command("map GRID... -o grid.nc [OPTIONS]")
def map(  # noqa: A001 - the command's name
    *grids: Path,
    output: cli.Grid,
    altitude: Annotated[float | None, Parameter(validator=validators.Number(gte=-1e6, lte=1e6))] = None,
    survey_altitude: Annotated[
        tuple[float, ...], Parameter(validator=validators.Number(gte=-1e6, lte=1e6))
    ] = (),
    smooth: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1e4))] = 0.0,
    mask: Path | None = None,
    spacing: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=inf))] = None,
    plot: cli.Plot = None,
    json: cli.Json = False,
) -> None:
    """Combine the grids of several surveys into one anomaly map: continue upward, merge, mask and smooth.

    Parameters
    ----------
    grids
        The grids to combine: netCDF, Surfer, Geosoft, ESRI ASCII, GeoTIFF or XYZ.
    output
        The map to write, netCDF.
    altitude
        Altitude in m to which every grid is continued upward; by default the altitude of the highest grid.
    survey_altitude
        Altitude in m of surveys whose grids do not state it: one value for all grids, or repeated, one value
        for each grid.
    smooth
        Wavelength in km at which smoothing halves the amplitude; the removed part is included in the map's
        sigma. By default the map is not smoothed.
    mask
        A CSV of longitude,latitude (deg) with the polygon outside which the map is blank.
    spacing
        Node spacing in deg; by default the spacing of the finest grid.
    plot
        A PNG, PDF or SVG to write, with a map of every step.
    """
    from magbridge.diagnostics import Diagnostic
    from magbridge.field.continuation import draw_steps, prepare, surveyed_at
    from magbridge.field.read import read_grid, read_polygon

    cli.check_inputs(grids, output, mask)
    polygon = read_polygon(mask) if mask else None
    with waiting("preparing"):
        flown = [read_grid(path) for path in grids]
        if survey_altitude:
            flown = surveyed_at(flown, survey_altitude)
        if len(flown) > 1 and not any(isfinite(grid.altitude) for grid in flown):
            cli.complain_all([Diagnostic("unknown_heights")])
        result, steps = prepare(flown, altitude, smooth, polygon, spacing)
    result.save(output)
    if plot:
        draw_steps(steps, plot)
    titles = [step.title for step in steps]
    cli.print_result({"steps": titles, "rms_nT": result.rms}, ", ".join(titles), json, output)
