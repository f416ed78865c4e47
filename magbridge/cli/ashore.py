"""Commands ashore that need no calibration: convert, simulate, map."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter, validators

from magbridge.cli.common import (
    AS_THEY_SAY,
    Grid,
    Heading,
    Json,
    Log,
    Plot,
    ReadingOptions,
    Whole,
    check_inputs,
    command,
    file_to_write,
    logs_to_read,
    print_result,
)
from magbridge.cli.remarks import note_losses
from magbridge.errors import WrongUse
from magbridge.progress import track, waiting
from magbridge.wording import counted


@command("convert FILE... -o FILE [OPTIONS]")
def convert(
    *files: Path,
    output: Log,
    heading_reference: Heading = None,
    metadata: Path | None = None,
    reading: ReadingOptions = AS_THEY_SAY,
    json: Json = False,
) -> None:
    """Convert logs from any readable format to any writable one; several logs are merged in time order.

    Parameters
    ----------
    files
        The logs to convert.
    output
        The file to write; its suffix sets the format: .csv .mcap .nc .parquet .tlog.
    metadata
        A metadata.toml that says of people, platform and sensor what OceanGliders OG1.0 demands: the netCDF
        is then a file of OG1.0.
    """
    logs_to_read(files, output, metadata)
    if metadata and output.suffix.lower() != ".nc":
        raise WrongUse(f"--metadata: goes with a netCDF (.nc), not with {output}")

    from magbridge.logs import Writer, read_chunks

    rows, pieces = 0, []
    with Writer(output, _og(metadata), og1=True) if metadata else Writer(output) as writer:
        for part in track(read_chunks(files, options=reading.options), "reading"):
            pieces.append(part.attrs)
            if heading_reference:
                part.attrs["heading_reference"] = heading_reference
            writer.append(part)
            rows += part.sizes["time"]
            names = [str(name) for name in part.data_vars]
    note_losses(*pieces)
    print_result(
        {"file": str(output), "rows": rows, "columns": names}, f"{output}: {counted(rows, 'row')}", json
    )


def _og(metadata: Path) -> Callable[[Path], None]:
    """Return a function that completes a netCDF file to one of OG1.0 with this metadata."""
    from magbridge.logs.og import complete, read_metadata

    return partial(complete, metadata=read_metadata(metadata))


@command("simulate SCENARIO -o FILE [OPTIONS]")
def simulate(
    scenario: Path,
    /,
    *,
    output: Log,
    seed: Annotated[Whole, Parameter(validator=validators.Number(gte=0))] = 0,
    trajectory_from: tuple[Path, ...] = (),
    reference: Literal["none", "true", "map"] | None = None,
    reading: ReadingOptions = AS_THEY_SAY,
    map_output: Annotated[Path | None, Parameter(name="--map", validator=file_to_write(".nc"))] = None,
    json: Json = False,
) -> None:
    """Simulate a deployment from the forward model.

    Parameters
    ----------
    scenario
        A scenario file, or one of the built-in demo, survey, bonne_bay, random_glider, comet and seaglider,
        of which the last two need a log to drive them (--trajectory-from); or turn_on, warming, bolt, pump
        and battery, in which the vehicle changes after its calibration.
    output
        The file to write.
    seed
        Determines everything that the scenario leaves open; the same seed gives the same deployment.
    trajectory_from
        A log whose attitude, position and masses drive the simulation instead of the scenario's mission;
        may be repeated. Each call makes a world around its logs: for one world, give all logs in one call.
    reference
        What reference_field holds, instead of what the scenario says: none leaves it out, as where the field
        is not known; true is the true total field; map is the main field and an airborne survey's anomaly.
    map_output
        Also write the anomaly grid that an aeromagnetic survey of the simulated world would have produced.
    """
    from magbridge.logs import read, write
    from sitl.like import placed_at, simulate_like
    from sitl.scenario import load
    from sitl.twin import Twin
    from sitl.twin import simulate as simulate_scenario

    check_inputs((scenario, *trajectory_from), output)
    check_inputs((scenario, *trajectory_from, output), map_output)
    if trajectory_from:
        logs_to_read(trajectory_from)
    chosen = load(scenario)
    if reference is not None:
        telemetry = msgspec.structs.replace(chosen.telemetry, reference=reference)
        chosen = msgspec.structs.replace(chosen, telemetry=telemetry)
    with waiting("simulating"):
        if trajectory_from:
            log = read(trajectory_from, options=reading.options)
            note_losses(log.attrs)
            chosen = placed_at(log, chosen)
            deployment = simulate_like(log, chosen, seed)
        else:
            deployment = simulate_scenario(chosen, seed)
    write(deployment, output)
    if map_output is not None:
        Twin.draw(chosen, seed).anomaly_map().save(map_output)
    rows = deployment.sizes["time"]
    print_result({"file": str(output), "rows": rows, "seed": seed}, f"{output}: {counted(rows, 'row')}", json)


@command("map GRID... -o grid.nc [OPTIONS]")
def map(  # noqa: A001 - the command's name
    *grids: Path,
    output: Grid,
    altitude: Annotated[float | None, Parameter(validator=validators.Number(gte=-1e6, lte=1e6))] = None,
    survey_altitude: Annotated[
        tuple[float, ...], Parameter(validator=validators.Number(gte=-1e6, lte=1e6))
    ] = (),
    smooth: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1e4))] = 0.0,
    mask: Path | None = None,
    spacing: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=inf))] = None,
    plot: Plot = None,
    json: Json = False,
) -> None:
    """Combine the grids of several surveys into one anomaly map: continue upward, merge, mask, smooth.

    Parameters
    ----------
    grids
        The grids: netCDF, Surfer, Geosoft, ESRI ASCII, GeoTIFF or XYZ.
    output
        The map to write, netCDF.
    altitude
        Altitude in m to which every grid is continued upward; by default that of the highest.
    survey_altitude
        Altitude in m of the surveys whose grids do not say it: one for all grids, or repeated, one for each.
    smooth
        Wavelength in km: of shorter waves less than half stays, and the part that is removed counts as the
        map's sigma. By default nothing is smoothed.
    mask
        A CSV of longitude,latitude (deg): the polygon outside which the map is blank.
    spacing
        Node spacing in deg; by default that of the finest grid.
    plot
        A PNG, PDF or SVG to draw, with every step.
    """
    from magbridge.field.prepare import draw_steps, prepare, surveyed_at
    from magbridge.field.read import read_grid, read_polygon

    check_inputs(grids, output, mask)
    polygon = read_polygon(mask) if mask else None
    with waiting("preparing"):
        flown = [read_grid(path) for path in grids]
        if survey_altitude:
            flown = surveyed_at(flown, survey_altitude)
        result, steps = prepare(flown, altitude, smooth, polygon, spacing)
    result.save(output)
    if plot:
        draw_steps(steps, plot)
    titles = [step.title for step in steps]
    facts = {"file": str(output), "steps": titles, "rms_nT": result.rms}
    print_result(facts, f"{output}: {', '.join(titles)}", json)
