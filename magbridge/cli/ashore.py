"""Commands ashore: convert, simulate, map, correct."""

from __future__ import annotations

from collections import Counter
from math import inf
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    Grid,
    Heading,
    Json,
    Log,
    Picture,
    Whole,
    app,
    check_inputs,
    complain,
    doubts_of,
    file_to_write,
    note_losses,
    note_missing,
    note_settings,
    print_result,
    refuse_unsuited,
)
from magbridge.progress import track, waiting


@app.command(usage="Usage: magbridge convert FILE... -o FILE [OPTIONS]")
def convert(*files: Path, output: Log, heading_reference: Heading = None, json: Json = False) -> None:
    """Convert logs from any readable format to any writable one; several logs are merged in time order.

    Parameters
    ----------
    files
        The logs to convert.
    output
        The file to write; its suffix sets the format: .csv .nc .parquet .tlog.
    heading_reference
        What headings refer to. If not given: what the log says, else true north.
    json
        Print the result as JSON.
    """
    from magbridge.logs import Writer, read_chunks

    rows, pieces = 0, []
    with Writer(output) as writer:
        for part in track(read_chunks(check_inputs(files, output)), "reading"):
            pieces.append(part.attrs)
            if heading_reference:
                part.attrs["heading_reference"] = heading_reference
            writer.append(part)
            rows += part.sizes["time"]
            names = [str(name) for name in part.data_vars]
    note_losses(*pieces)
    print_result({"file": str(output), "rows": rows, "columns": names}, f"{output}: {rows} rows", json)


@app.command(usage="Usage: magbridge simulate SCENARIO -o FILE [OPTIONS]")
def simulate(
    scenario: Path,
    /,
    *,
    output: Log,
    seed: Annotated[Whole, Parameter(validator=validators.Number(gte=0))] = 0,
    like: tuple[Path, ...] = (),
    map_output: Annotated[Path | None, Parameter(name="--map", validator=file_to_write(".nc"))] = None,
    json: Json = False,
) -> None:
    """Simulate a deployment from the forward model.

    Parameters
    ----------
    scenario
        A scenario file, or one of the built-in demo, survey, bonne_bay, random_glider, comet and seaglider;
        the last two need a log to drive them (--like).
    output
        The file to write.
    seed
        Determines everything that the scenario leaves open; the same seed gives the same deployment.
    like
        A log whose attitude, position and masses drive the simulation instead of the scenario's mission;
        may be repeated.
    map_output
        Also write the anomaly grid that an aeromagnetic survey of the simulated world would have produced.
    json
        Print the result as JSON.
    """
    from magbridge.logs import read, write
    from sitl.like import placed_at, simulate_like
    from sitl.scenario import load
    from sitl.twin import Twin
    from sitl.twin import simulate as simulate_scenario

    check_inputs((scenario, *like), output)
    check_inputs((scenario, *like, output), map_output)
    chosen = load(scenario)
    with waiting("simulating"):
        if like:
            log = read(like)
            note_losses(log.attrs)
            chosen = placed_at(log, chosen)
            deployment = simulate_like(log, chosen, seed)
        else:
            deployment = simulate_scenario(chosen, seed)
    write(deployment, output)
    if map_output is not None:
        Twin.draw(chosen, seed).anomaly_map().save(map_output)
    rows = deployment.sizes["time"]
    print_result({"file": str(output), "rows": rows, "seed": seed}, f"{output}: {rows} rows", json)


@app.command(usage="Usage: magbridge map GRID... -o grid.nc [OPTIONS]")
def map(  # noqa: A001 - the command's name
    *grids: Path,
    output: Grid,
    altitude: Annotated[float | None, Parameter(validator=validators.Number(gte=-1e6, lte=1e6))] = None,
    passes: Annotated[Whole, Parameter(validator=validators.Number(gte=0, lte=10_000))] = 20,
    mask: Path | None = None,
    spacing: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=inf))] = None,
    picture: Picture = None,
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
    passes
        Number of passes of the 3x3 Hanning smoothing kernel.
    mask
        A CSV of longitude,latitude (deg): the polygon outside which the map is blank.
    spacing
        Node spacing in deg; by default that of the finest grid.
    picture
        A PNG, PDF or SVG to draw, with every step.
    json
        Print the result as JSON.
    """
    from magbridge.field.prepare import draw_steps, prepare
    from magbridge.field.read import read_grid, read_polygon

    check_inputs(grids, output, mask)
    polygon = read_polygon(mask) if mask else None
    with waiting("preparing"):
        result, steps = prepare([read_grid(path) for path in grids], altitude, passes, polygon, spacing)
    result.save(output)
    if picture:
        draw_steps(steps, picture)
    titles = [step.title for step in steps]
    facts = {"file": str(output), "steps": titles, "rms_nT": result.rms}
    print_result(facts, f"{output}: {', '.join(titles)}", json)


@app.command(usage="Usage: magbridge correct FILE... --calibration cal.json -o FILE [OPTIONS]")
def correct(*files: Path, calibration: Path, output: Log, json: Json = False) -> None:
    """Correct a log with a calibration, as the bridge would have done live.

    The arithmetic and the state (lags, backlash) are the bridge's own, but the input is the log's rows. In a
    bridge's own log (also converted to .nc or .parquet) these are MAG_RAW with the latest telemetry before
    each and its age; [align] and every max_age are known as they were when the log began, not as they were
    set later. The bridge itself uses every message about a moving mass, and the channels of a sensor that has
    no counts are float32 here (to 0.002 nT of 50,000 nT). Of another log, telemetry counts as new in every
    row that has it, and rows that have nothing else are not samples: they are left out of the output. For
    what the bridge would have published bit for bit, put the calibration into a bridge.toml and run:
    magbridge replay LOG --config bridge.toml --log DIR. The replay also reports that this differs from what
    was published at the time.

    Parameters
    ----------
    files
        The logs of one deployment.
    calibration
        The calibration (cal.json).
    output
        The file to write: total field with its sigma, vector, anomaly and quality flags.
    json
        Print the result as JSON.
    """
    from magbridge.calibration.file import load
    from magbridge.columns import CHANNELS
    from magbridge.correction import Correction, correct_rows
    from magbridge.errors import DataError
    from magbridge.field.reference import EARTHS
    from magbridge.logs import Writer, read_chunks
    from magbridge.records import Quality

    check_inputs(files, output, calibration)
    known = load(calibration)
    for doubt in doubts_of(known, calibration):
        complain(doubt)
    correction = Correction(known)
    rows, flagged, left_out, beyond, whole = 0, 0, 0, 0, False
    pieces: list[dict[str, Any]] = []
    flags: Counter[str] = Counter()
    doubtful = ~Quality.NO_BORESIGHT  # without a boresight, the total field is just as good
    with Writer(output) as writer:
        for part in track(read_chunks(files, required=CHANNELS), "correcting"):
            if not pieces:
                note_missing(known, part)
            pieces.append(part.attrs)
            sampled = part[list(CHANNELS)].to_array().notnull()
            corrected = correct_rows(correction, part).isel(time=sampled.any("variable").to_numpy())
            writer.append(corrected)
            rows += corrected.sizes["time"]
            left_out += part.sizes["time"] - corrected.sizes["time"]
            total = corrected["total_field"]
            beyond += int(((total < EARTHS[0]) | (total > EARTHS[1])).sum())
            if not whole:
                refuse_unsuited(known, part)
                whole = bool(sampled.all("variable").any())
            quality = corrected["quality"].to_numpy().astype(int)
            flagged += int((quality & doubtful != 0).sum())
            flags.update({flag.names(): int((quality & flag != 0).sum()) for flag in doubtful})
        if not whole:
            raise DataError(
                f"{', '.join(str(file) for file in files)}: no row has all of {' '.join(CHANNELS)}"
            )
    note_losses(*pieces)
    note_settings(*pieces)
    if beyond > rows / 2:
        low, high = (f"{limit:,.0f}" for limit in EARTHS)
        complain(
            f"{calibration}: another vehicle's? {beyond} of {rows} corrected total fields are none of the "
            f"Earth's, {low} to {high} nT"
        )
    facts = {"file": str(output), "rows": rows, "flagged": flagged, "flags": +flags, "left_out": left_out}
    named = ", ".join(f"{name} {count}" for name, count in (+flags).items())
    summary = f"{output}: {rows} samples, {flagged} of them flagged" + (f" ({named})" if named else "")
    summary += f"; {left_out} rows without any of {' '.join(CHANNELS)} left out" if left_out else ""
    print_result(facts, summary, json)
