"""Define the commands ``survey``, which makes an anomaly map, and ``plan``, which plans runs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import CalibrationError, DataError, WrongUse
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.fitting.fit import Fit
    from magbridge.survey.run import Result
    from magbridge.survey.samples import Samples


@Parameter(name="*")
@dataclass(frozen=True)
class CorrectionOptions:
    """Options for the correction of raw logs.

    Parameters
    ----------
    calibration
        A calibration (cal.json) to use instead of fitting one; may be repeated, once for each raw log in
        order.
    save
        A file (cal.json) for the fitted calibration.
    """

    calibration: tuple[Path, ...] = ()
    save: cli.SavedCalibration = None


@Parameter(name="*")
@dataclass(frozen=True)
class MapOptions:
    """Options for the map and other products of the corrected samples.

    Parameters
    ----------
    spacing
        Distance between nodes of the map in m; by default an eighth of the crustal field's correlation
        length.
    altitude
        Altitude in m to which the map is continued upward; by default the altitude of the survey.
    predict
        A table of points with longitude and latitude (and height or depth). The output is then a table of
        anomaly, anomaly_sigma and level_sigma at these points, instead of a map.
    geotiff
        A file for the map as GeoTIFF, in addition.
    tracks
        A file for the tracks, GeoJSON or KML.
    crossovers
        A table (.csv) to write of the crossovers, with their mis-ties before and after levelling.
    plot
        A PNG, PDF or SVG to write, with map, sigma, track, residuals and crossovers.
    """

    spacing: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=inf))] = None
    altitude: Annotated[float | None, Parameter(validator=validators.Number(gte=-1e6, lte=1e6))] = None
    predict: Path | None = None
    geotiff: Annotated[Path | None, Parameter(validator=cli.file_to_write(".tif", ".tiff"))] = None
    tracks: Annotated[Path | None, Parameter(validator=cli.file_to_write(".geojson", ".json", ".kml"))] = None
    crossovers: Annotated[Path | None, Parameter(validator=cli.file_to_write(".csv"))] = None
    plot: cli.Plot = None


SELF_CALIBRATED = CorrectionOptions()
MAP_ONLY = MapOptions()


@cli.command("survey LOG... -o map.nc [OPTIONS]")
def survey(
    *logs: Path,
    output: cli.Output,
    fit: cli.FitOptions = cli.NO_PARAMETERS,
    correction: CorrectionOptions = SELF_CALIBRATED,
    scalar: cli.ScalarOptions = cli.NO_SCALAR,
    products: MapOptions = MAP_ONLY,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Make an anomaly map and its sigma from the logs of a survey, without calibration runs or another map.

    Unless a calibration is given, the command fits one to the raw logs together with the crustal field. It
    levels the lines, subtracts slow changes with time, and grids the field.

    With --strict, the exit code is also 1 if the data do not support the calibration.

    Parameters
    ----------
    logs
        The survey's logs: raw (mag_x mag_y mag_z), or corrected elsewhere (total_field or anomaly, with line
        and line_type if available). A corrected log may be a table without times.
    output
        The map to write, netCDF (.nc), for navigate --map. With --predict: the predictions (.csv).
    """
    from magbridge.survey.maps import write_crossovers, write_tracks
    from magbridge.survey.run import facts, summary
    from magbridge.survey.run import survey as make

    cli.logs_to_read(logs, output, fit.base, products.predict, *correction.calibration)
    if products.predict is None and output.suffix.lower() != ".nc":
        raise WrongUse(f"{output}: expected a map's name that ends in .nc")
    if (correction.calibration or scalar.scalar) and correction.save:
        raise WrongUse("--save: --calibration and --scalar find no calibration to write; leave --save out")
    scalar.check()
    with waiting("surveying"):
        if scalar.scalar:
            done = _scalar_survey(logs, scalar, fit, correction.calibration, reading)
        else:
            done = make(_samples(logs, fit, correction, reading))
    cli.complain_all(done.warnings)
    if products.predict:
        _predict(done, products.predict, output)
    else:
        _map(done, output, products)
    if products.tracks:
        write_tracks(done.samples, products.tracks)
    if products.crossovers:
        write_crossovers(done.found, done.samples, done.before, done.after, products.crossovers)
    cli.print_result(facts(done, output), f"{output}: {summary(done)}", json)


def _scalar_survey(
    files: tuple[Path, ...],
    scalar: cli.ScalarOptions,
    fit: cli.FitOptions,
    calibrations: tuple[Path, ...],
    reading: cli.ReadingOptions,
) -> Result:
    """Return the survey result from the column of a scalar magnetometer."""
    from magbridge.calibration.fitting.scalar_log import telemetry_columns
    from magbridge.field.reference import with_true_heading
    from magbridge.logs import read_each
    from magbridge.survey.run import scalar_survey

    column = scalar.scalar
    logs = cli.by_base_station(read_each(list(files), options=reading.options), fit.base)
    logs = [with_true_heading(log) for log in logs]
    cli.note_losses(*(log.attrs for log in logs))
    known = [mb.load(path) for path in calibrations]
    for path, found in zip(calibrations, known, strict=True):
        if all(sensor.column != column for sensor in found.sensors):
            cli.complain(
                f"{path}: expected a scalar sensor {column!r}, got none: it is not compensated; fit with "
                f"magbridge calibrate --scalar {column}"
            )
    names: Sequence[str] = fit.named
    if "auto" in fit.parameter:
        names = sorted({name for log in logs for name in telemetry_columns(log, column)})
    return scalar_survey(logs, column, names, known, lag=scalar.lag_s, lever=scalar.lever_m)


def _samples(
    files: tuple[Path, ...], fit: cli.FitOptions, correction: CorrectionOptions, reading: cli.ReadingOptions
) -> Samples:
    """Return the samples of all files, corrected; raw logs without a calibration are calibrated first."""
    from magbridge.columns import CHANNELS
    from magbridge.field.reference import placed
    from magbridge.logs import read_each
    from magbridge.survey.read import is_table, joined, read_table, without_creep
    from magbridge.survey.run import samples_of

    tables = [path for path in files if is_table(path)]
    others = [path for path in files if path not in tables]
    parts = [read_table(path) for path in tables]
    if not others:
        return joined(parts)
    deployments = cli.by_base_station(read_each(others, options=reading.options), fit.base)
    cli.note_losses(*(one.attrs for one in deployments))
    raw = [one for one in deployments if all(name in one for name in CHANNELS)]
    known = [mb.load(path) for path in correction.calibration]
    for log in deployments if known else []:
        if {"latitude", "longitude"} <= set(log.variables) and (holes := int((~placed(log)).sum())):
            cli.complain(f"{log.attrs['source']}: {counted(holes, 'sample')} without a position: left out")
    for path, one in zip(correction.calibration, known, strict=True):
        cli.complain_all(cli.warnings_of(one, path))
    if raw and not known:
        found = _calibrated(raw, fit, correction.save, strict=reading.strict)
        known = [found.calibration if found.creep is None else found.creep.calibration]
        deployments = [without_creep(one, found.creep) for one in deployments]
    return joined([*parts, samples_of(deployments, known)])


def _calibrated(logs: list[xr.Dataset], fit: cli.FitOptions, save: Path | None, *, strict: bool) -> Fit:
    """Return the fit of a calibration to the raw logs of the survey; write the calibration if requested."""
    from magbridge.calibration.fitting.observe import observations
    from magbridge.columns import require
    from magbridge.logs.deployment import join

    together, order, options = join(logs), fit.order, fit.drift
    parameters = cli.chosen_parameters(fit.parameter, together, order=order, **options)
    require(together, parameters)
    with cli.naming(together):
        data = observations(together, parameters)
        found = mb.fit(data, order=order, **options)
    if not found.supported and data.lacks_rock and found.calibration.method == "auto":
        with suppress(CalibrationError):  # a map must not attribute the crustal field to the vehicle
            found = mb.fit(data, "survey", order=order, **options)
    cli.complain_all(found.warnings)
    if strict and not found.supported:
        raise DataError(
            f"{together.attrs['source']}: the survey does not support a calibration, for the reasons "
            "above; leave --strict out to use it all the same"
        )
    if save:
        mb.save(found.calibration, save)
    return found


def _predict(done: Result, points: Path, output: Path) -> None:
    """Write the anomaly and its sigma at the points in a table."""
    from magbridge.survey.maps import write_points
    from magbridge.survey.read import read_points

    longitude, latitude, depth, place = read_points(points, done.samples.origin)
    anomaly, sigma = done.gridded.evaluate(place, depth)
    write_points(longitude, latitude, anomaly, sigma, done.samples.level_sigma, output)


def _map(done: Result, output: Path, products: MapOptions) -> None:
    """Write the map, and its GeoTIFF and plot if requested."""
    from magbridge.survey.maps import anomaly_map, write_geotiff

    spacing, altitude = products.spacing, products.altitude
    grid = anomaly_map(done.gridded, done.samples, spacing=spacing, altitude=altitude, name=output.name)
    grid.save(output)
    if products.geotiff:
        write_geotiff(grid, products.geotiff)
    if products.plot:
        from magbridge.survey.draw import draw_survey

        changes = done.before, done.after
        draw_survey(grid, done.samples, done.residual, done.found, changes, products.plot)


@cli.command("plan --mission FILE [--calibration cal.json] [--survey HOURS] [OPTIONS]")
def plan(
    *,
    mission: Path,
    calibration: Path | None = None,
    runs: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=1, lte=100))] = 10,
    survey: Annotated[float | None, Parameter(validator=validators.Number(gte=0.5, lte=1000))] = None,
    parameter: tuple[str, ...] = (),
    roll: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=90))] = 10.0,
    heading_reference: cli.Heading = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Choose the next calibration runs so that the largest error of the mission becomes smallest.

    With --survey, the command instead proposes patterns of a survey that calibrates itself, without runs and
    without a map, with the expected accuracy of each pattern.

    Parameters
    ----------
    mission
        A real or simulated log with the attitude, position and moving masses of the planned mission.
    calibration
        The present calibration (cal.json); with --survey it is optional.
    runs
        Number of spirals to choose.
    survey
        Largest duration of a survey, in hours.
    parameter
        With --survey and without --calibration: a column with the position of a moving mass; may be repeated.
    roll
        Largest bank angle of the vehicle in deg, to either side.
    """
    from magbridge.calibration.planning import plan as flights
    from magbridge.calibration.planning import survey_patterns

    if calibration is None and survey is None:
        raise WrongUse("expected --calibration, or --survey HOURS to plan a survey without one")
    cli.logs_to_read((mission,), None, calibration)
    deployment = cli.read_log(mission, reading, heading_reference)
    known = mb.load(calibration) if calibration else None
    with cli.naming(deployment), waiting("planning"):
        if survey is None:
            assert known is not None
            found = flights.flight_plan(known, deployment, runs=runs, roll=roll)
            result = flights.facts(found, known), flights.summary(found, known)
        else:
            proposed = survey_patterns.survey_plan(known, deployment, parameter, hours=survey, roll=roll)
            cli.complain_all(proposed[0].open)
            result = survey_patterns.facts(proposed), survey_patterns.summary(proposed)
    cli.print_result(*result, json)
