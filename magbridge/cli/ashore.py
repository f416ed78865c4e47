"""Commands ashore: convert, simulate, map, correct."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    Grid,
    Heading,
    Json,
    Log,
    Picture,
    Whole,
    app,
    file_to_write,
    note_losses,
    some,
    tell,
)
from magbridge.progress import track, waiting


@app.command(usage="Usage: magbridge convert FILE... -o FILE [OPTIONS]")
def convert(*files: Path, output: Log, heading_reference: Heading = None, json: Json = False) -> None:
    """Convert logs of any readable format to any writable one; several are joined in time.

    Parameters
    ----------
    files
        Logs.
    output
        The file to write; its suffix says the format: .csv .nc .parquet .tlog.
    heading_reference
        What headings are counted from; if not given what the log says, else true north.
    json
        Print the result for machines.
    """
    from magbridge.logs import Writer, read_chunks

    rows, pieces = 0, []
    with Writer(output) as writer:
        for part in track(read_chunks(some(files, output)), "reading"):
            pieces.append(part.attrs)
            if heading_reference:
                part.attrs["heading_reference"] = heading_reference
            writer.append(part)
            rows += part.sizes["time"]
            names = [str(name) for name in part.data_vars]
    note_losses(*pieces)
    tell({"file": str(output), "rows": rows, "columns": names}, f"{output}: {rows} rows", json)


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
        A scenario file, or the name of one that comes with magbridge: demo, survey, bonne_bay,
        random_glider; comet and seaglider are driven by a log (--like).
    output
        The file to write.
    seed
        Draws everything that the scenario leaves open; the same seed gives the same deployment.
    like
        A log whose attitude, position and masses drive the simulation instead of the scenario's mission; again for each further one.
    map_output
        Where to write the anomaly grid that an aeromagnetic survey of the simulated world would have made.
    json
        Print the result for machines.
    """
    from magbridge.logs import read, write
    from sitl.like import simulate_like, where
    from sitl.scenario import load
    from sitl.twin import Twin
    from sitl.twin import simulate as simulate_scenario

    some((scenario, *like), output)
    some((scenario, *like, output), map_output)
    chosen = load(scenario)
    with waiting("simulating"):
        if like:
            log = read(like)
            note_losses(log.attrs)
            chosen = where(log, chosen)
            deployment = simulate_like(log, chosen, seed)
        else:
            deployment = simulate_scenario(chosen, seed)
    write(deployment, output)
    if map_output is not None:
        Twin.draw(chosen, seed).anomaly_map().save(map_output)
    rows = deployment.sizes["time"]
    tell({"file": str(output), "rows": rows, "seed": seed}, f"{output}: {rows} rows", json)


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
    """Make one anomaly map from the grids of several surveys: continue upward, merge, mask, smooth.

    Parameters
    ----------
    grids
        Grids: netCDF, Surfer, Geosoft, ESRI ASCII, GeoTIFF, XYZ.
    output
        The map to write, netCDF.
    altitude
        m to which every grid is continued upward; the highest of theirs if not given.
    passes
        How often the 3x3 Hanning kernel is applied.
    mask
        A CSV of longitude,latitude (deg): the polygon at which the map ends.
    spacing
        deg; the finest of the grids' if not given.
    picture
        A PNG, PDF or SVG with every step.
    json
        Print the result for machines.
    """
    from magbridge.field.prepare import draw_steps, prepare
    from magbridge.field.read import read_grid, read_polygon

    some(grids, output, mask)
    polygon = read_polygon(mask) if mask else None
    with waiting("preparing"):
        result, steps = prepare([read_grid(path) for path in grids], altitude, passes, polygon, spacing)
    result.save(output)
    if picture:
        draw_steps(steps, picture)
    titles = [step.title for step in steps]
    facts = {"file": str(output), "steps": titles, "rms_nT": result.rms}
    tell(facts, f"{output}: {', '.join(titles)}", json)


@app.command(usage="Usage: magbridge correct FILE... --calibration cal.json -o FILE [OPTIONS]")
def correct(*files: Path, calibration: Path, output: Log, json: Json = False) -> None:
    """Correct a log with a calibration, as the bridge would have done live.

    The arithmetic and the state (lags, backlash) are the bridge's own; the input is what the log's rows hold. Of a bridge's own log
    that is MAG_RAW, in which a channel is a float32 (to 0.002 nT of 50,000 nT), and the telemetry last said before it: while a mass
    moves, the bridge itself reads its position off between messages, by their own times. Nor is [align] of bridge.toml known here.
    What the bridge would have published with this calibration, bit for bit, a replay writes: magbridge replay LOG --config
    bridge.toml --log DIR, with the calibration in that bridge.toml; that it is not what was published it then says, too.

    Parameters
    ----------
    files
        Logs of one deployment.
    calibration
        The cal.json.
    output
        The file to write: total field with its sigma, vector, anomaly and quality.
    json
        Print the result for machines.
    """
    from magbridge.calibration.file import load
    from magbridge.columns import CHANNELS
    from magbridge.correction import Correction, correct_rows
    from magbridge.logs import Writer, read_chunks
    from magbridge.records import Quality

    some(files, output, calibration)
    correction = Correction(load(calibration))
    rows, flagged, pieces = 0, 0, []
    with Writer(output) as writer:
        for part in track(read_chunks(files, required=CHANNELS), "correcting"):
            pieces.append(part.attrs)
            corrected = correct_rows(correction, part)
            writer.append(corrected)
            rows += part.sizes["time"]
            flagged += int(
                (corrected["quality"].to_numpy().astype(int) & ~int(Quality.NO_BORESIGHT) != 0).sum()
            )
    note_losses(*pieces)
    summary = f"{output}: {rows} samples, {flagged} of them flagged"
    tell({"file": str(output), "rows": rows, "flagged": flagged}, summary, json)
