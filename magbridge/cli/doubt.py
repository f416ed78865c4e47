"""Commands that doubt and use what was corrected: diagnose, navigate."""

from __future__ import annotations

import sys
from pathlib import Path

from magbridge.cli.common import Json, Output, app, complain, some, tell


@app.command
def diagnose(
    *files: Path,
    calibration: Path,
    output: Output,
    learned_from: tuple[Path, ...] = (),
    grid: Path | None = None,
    json: Json = False,
) -> None:
    """Say what the simulation gets wrong, why, and what mending it gains.

    Writes report.html, findings.json and calibration.json, the extended model, which correct, run and replay take.

    Parameters
    ----------
    files
        Logs that the calibration has not seen; each file, and each pause, is a dive of its own.
    calibration
        The cal.json.
    output
        The folder to write to.
    learned_from
        The logs that the calibration was made from.
    grid
        An anomaly grid, added to the IGRF.
    json
        Print the findings for machines.
    """
    from magbridge.calibration.file import load
    from magbridge.diagnose.causes import CAUSES
    from magbridge.diagnose.findings import findings
    from magbridge.diagnose.run import diagnose as examine
    from magbridge.field.read import read_grid
    from magbridge.logs import read

    found = examine(
        [read(path) for path in some(files)],
        load(calibration),
        output,
        learned_from=[read(path) for path in learned_from],
        grid=read_grid(grid) if grid else None,
        progress=_step,
    )
    facts = findings(found, CAUSES)
    causes = [
        f"{one['cause']} ({one['channel']})" if one["channel"] else one["cause"] for one in facts["findings"]
    ]
    rms = f"{facts['rms_before_nT']:.2f} -> {facts['rms_after_nT']:.2f} nT RMS held out"
    tell(
        facts, f"{facts['verdict']}: {', '.join(causes) or 'no cause'}; {rms}; {output / 'report.html'}", json
    )


@app.command
def navigate(
    file: Path,
    *more: Path,
    calibration: Path,
    map: Path,  # noqa: A002 - the flag's name
    output: Output,
    picture: Path | None = None,
    json: Json = False,
) -> None:
    """Match the corrected field to an anomaly map: track, covariance, innovations, smoothed track.

    Parameters
    ----------
    file
        A log with telemetry from which motion can be reckoned.
    more
        Further logs of the same deployment.
    calibration
        The cal.json.
    map
        The anomaly grid.
    output
        The file to write.
    picture
        A PNG: the tracks on the map, errors and innovations.
    json
        Print the result for machines.
    """
    from magbridge.calibration.file import load
    from magbridge.columns import CHANNELS
    from magbridge.config import Align
    from magbridge.correction import Correction, correct_rows
    from magbridge.field.declination import with_true_heading
    from magbridge.field.read import read_grid
    from magbridge.logs import read, write
    from magbridge.navigate.batch import navigate as find_way

    deployment = with_true_heading(read((file, *more), required=CHANNELS))
    corrected = correct_rows(Correction(load(calibration), Align()), deployment)
    grid = read_grid(map)
    track = find_way(deployment.assign(corrected.data_vars), grid)
    write(track, output)
    if picture:
        from magbridge.navigate.draw import draw_navigation

        draw_navigation(track, grid, picture)
    for finding in track.attrs["findings"].splitlines():
        complain(finding, 0)
    facts = {"file": str(output), "rows": track.sizes["time"], **track.attrs}
    tell(facts, f"{output}: {track.sizes['time']} updates", json)


def _step(name: str) -> None:
    if sys.stderr.isatty():
        print(name, file=sys.stderr)
