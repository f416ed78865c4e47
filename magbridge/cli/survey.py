"""From a survey's logs to its anomaly map."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    AS_THEY_SAY,
    NO_SCALAR,
    Base,
    Json,
    Output,
    Plot,
    ReadingOptions,
    SavedCalibration,
    ScalarOptions,
    Whole,
    command,
    complain,
    file_to_write,
    logs_to_read,
    print_result,
)
from magbridge.cli.remarks import by_base_station, chosen_parameters, naming, note_losses, warnings_of
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
    """How raw logs are corrected.

    Parameters
    ----------
    parameter
        A column that gives the position of a moving mass, or a current; may be repeated. auto: those of the
        log that predict held-out parts better.
    order
        Highest total degree of the polynomials in the parameters.
    calibration
        A calibration (cal.json) to correct with instead; may be repeated, once for each raw log in order.
    save
        The calibration found, to write (cal.json).
    position_sigma
        As of calibrate: by how many m dead-reckoned positions slowly drift, while the calibration is found.
    base
        A base station's log (total_field, or a vector): its variation is subtracted. A log of an
        observatory (IAGA-2002) among the logs is used in the same way.
    """

    parameter: tuple[str, ...] = ()
    order: Annotated[Whole, Parameter(validator=validators.Number(gte=1, lte=6))] = 3
    calibration: tuple[Path, ...] = ()
    save: SavedCalibration = None
    position_sigma: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1e5))] = 0.0
    base: Base = None


@Parameter(name="*")
@dataclass(frozen=True)
class MapOptions:
    """Products of the corrected samples.

    Parameters
    ----------
    spacing
        m between nodes of the map; by default an eighth of the crustal field's length.
    altitude
        m above the sea to which the map is continued upward; by default that of the survey.
    predict
        A table with longitude and latitude (and height or depth): anomaly and anomaly_sigma there are
        written to the output, instead of a map.
    geotiff
        The map as GeoTIFF, too.
    tracks
        The tracks, as GeoJSON or KML.
    crossovers
        A table of the crossovers with their mis-ties before and after levelling.
    plot
        A PNG, PDF or SVG to draw: map, sigma, track, residuals, crossovers.
    """

    spacing: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=inf))] = None
    altitude: Annotated[float | None, Parameter(validator=validators.Number(gte=-1e6, lte=1e6))] = None
    predict: Path | None = None
    geotiff: Annotated[Path | None, Parameter(validator=file_to_write(".tif", ".tiff"))] = None
    tracks: Annotated[Path | None, Parameter(validator=file_to_write(".geojson", ".json", ".kml"))] = None
    crossovers: Annotated[Path | None, Parameter(validator=file_to_write(".csv"))] = None
    plot: Plot = None


SELF_CALIBRATED = CorrectionOptions()
MAP_ONLY = MapOptions()


@command("survey LOG... -o map.nc [OPTIONS]")
def survey(
    *logs: Path,
    output: Output,
    correction: CorrectionOptions = SELF_CALIBRATED,
    scalar: ScalarOptions = NO_SCALAR,
    products: MapOptions = MAP_ONLY,
    reading: ReadingOptions = AS_THEY_SAY,
    json: Json = False,
) -> None:
    """Make an anomaly map, with its sigma, from a survey's own logs: no calibration runs, no map.

    Raw logs are calibrated with an estimate of the crustal field, from the same data, unless a calibration is
    given. Lines are levelled, slow changes with time are subtracted, and the field is gridded.

    With --strict, also exit with 1 when the data do not support the calibration.

    Parameters
    ----------
    logs
        The survey's logs: raw (mag_x mag_y mag_z), or corrected elsewhere (total_field or anomaly, with line
        and line_type where there are any), also a plain table without times.
    output
        The map, netCDF (.nc): what navigate --map takes. With --predict: the predictions (.csv).
    """
    from magbridge.survey.run import facts, summary
    from magbridge.survey.run import survey as make
    from magbridge.survey.write import write_crossovers, write_tracks

    logs_to_read(logs, output, correction.base, products.predict, *correction.calibration)
    if products.predict is None and output.suffix.lower() != ".nc":
        raise WrongUse(f"{output}: a map's name must end in .nc")
    if (correction.calibration or scalar.scalar) and correction.save:
        raise WrongUse("--save: with --calibration or --scalar no calibration is found; leave --save out")
    scalar.check()
    with waiting("surveying"):
        if scalar.scalar:
            done = _scalar_survey(logs, scalar, correction, reading)
        else:
            done = make(_samples(logs, correction, reading))
    for warning in done.warnings:
        complain(warning.text)
    if products.predict:
        _predict(done, products.predict, output)
    else:
        _map(done, output, products)
    if products.tracks:
        write_tracks(done.samples, products.tracks)
    if products.crossovers:
        write_crossovers(done.found, done.samples, done.before, done.after, products.crossovers)
    print_result(facts(done, output), f"{output}: {summary(done)}", json)


def _scalar_survey(
    files: tuple[Path, ...], scalar: ScalarOptions, correction: CorrectionOptions, reading: ReadingOptions
) -> Result:
    """Return the survey of a scalar magnetometer."""
    from magbridge.calibration.file import load
    from magbridge.calibration.fitting.scalar_log import telemetry_columns
    from magbridge.field.reference import with_true_heading
    from magbridge.logs import read_each
    from magbridge.survey.run import scalar_survey

    column = scalar.scalar
    logs = by_base_station(read_each(list(files), options=reading.options), correction.base)
    logs = [with_true_heading(log) for log in logs]
    note_losses(*(log.attrs for log in logs))
    known = [load(path) for path in correction.calibration]
    for path, found in zip(correction.calibration, known, strict=True):
        if all(sensor.column != column for sensor in found.sensors):
            complain(
                f"{path}: has no scalar sensor {column!r}, which is not compensated; fit it with "
                f"magbridge calibrate --scalar {column}"
            )
    names = [name for name in correction.parameter if name != "auto"]
    if "auto" in correction.parameter:
        names = sorted({name for log in logs for name in telemetry_columns(log, column)})
    return scalar_survey(logs, column, names, known, lag=scalar.lag_s, lever=scalar.lever_m)


def _samples(files: tuple[Path, ...], correction: CorrectionOptions, reading: ReadingOptions) -> Samples:
    """Return the corrected samples of all files."""
    from magbridge.calibration.file import load
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
    deployments = by_base_station(read_each(others, options=reading.options), correction.base)
    note_losses(*(one.attrs for one in deployments))
    raw = [one for one in deployments if all(name in one for name in CHANNELS)]
    known = [load(path) for path in correction.calibration]
    for log in deployments if known else []:
        if {"latitude", "longitude"} <= set(log.variables) and (holes := int((~placed(log)).sum())):
            complain(f"{log.attrs['source']}: {counted(holes, 'sample')} without a position: left out")
    for path, one in zip(correction.calibration, known, strict=True):
        for line in warnings_of(one, path):
            complain(line)
    if raw and not known:
        found = _calibrated(raw, correction, strict=reading.strict)
        known = [found.calibration if found.creep is None else found.creep.calibration]
        deployments = [without_creep(one, found.creep) for one in deployments]
    return joined([*parts, samples_of(deployments, known)])


def _calibrated(logs: list[xr.Dataset], correction: CorrectionOptions, *, strict: bool) -> Fit:
    """Return the fit that the raw logs give themselves; write it where that is asked for."""
    from magbridge.calibration.file import save
    from magbridge.calibration.fitting.fit import fit
    from magbridge.calibration.fitting.observe import observations
    from magbridge.columns import require
    from magbridge.logs.deployment import join

    together, order = join(logs), correction.order
    options: dict[str, Any] = {}
    if correction.position_sigma:
        options["position_sigma"] = correction.position_sigma
    parameters = chosen_parameters(correction.parameter, together, order=order, **options)
    require(together, parameters)
    with naming(together):
        data = observations(together, parameters)
        found = fit(data, order=order, **options)
    if not found.supported and data.lacks_rock and found.calibration.method == "auto":
        with suppress(CalibrationError):  # a map must not attribute the crustal field to the vehicle
            found = fit(data, "survey", order=order, **options)
    for warning in found.warnings:
        complain(warning.text)
    if strict and not found.supported:
        raise DataError(
            "the survey does not support a calibration (see the warnings), and --strict was given"
        )
    if correction.save:
        save(found.calibration, correction.save)
    return found


def _predict(done: Result, points: Path, output: Path) -> None:
    """Write the anomaly at the user's points."""
    from magbridge.survey.read import read_points
    from magbridge.survey.write import write_points

    longitude, latitude, depth, place = read_points(points, done.samples.origin)
    anomaly, sigma = done.gridded.evaluate(place, depth)
    write_points(longitude, latitude, anomaly, sigma, output)


def _map(done: Result, output: Path, products: MapOptions) -> None:
    """Write the map in every form that is asked for."""
    from magbridge.survey.maps import anomaly_map
    from magbridge.survey.write import write_geotiff

    spacing, altitude = products.spacing, products.altitude
    grid = anomaly_map(done.gridded, done.samples, spacing=spacing, altitude=altitude, name=output.name)
    grid.save(output)
    if products.geotiff:
        write_geotiff(grid, products.geotiff)
    if products.plot:
        from magbridge.survey.draw import draw_survey

        changes = done.before, done.after
        draw_survey(grid, done.samples, done.residual, done.found, changes, products.plot)
