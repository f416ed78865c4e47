"""Define the command ``navigate``, which estimates a track from the field, or its accuracy in advance."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import ConfigError, DataError, WrongUse
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.field.grid import AnomalyGrid
    from magbridge.navigate import NavigationOptions


@cli.command("navigate FILE... --calibration cal.json --map grid.nc -o FILE [OPTIONS]")
def navigate(
    *files: Path,
    output: cli.Log,
    map: Path | None = None,  # noqa: A002 - the flag's name
    calibration: Path | None = None,
    config: Path | None = None,
    bound: bool = False,
    sample_interval: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lte=1e6))] = None,
    plot: cli.Plot = None,
    heading_reference: cli.Heading = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Find the track by matching the corrected field to an anomaly map.

    The output is the filtered and the smoothed track with covariance and innovations. Without --map, the
    command corrects the track where it crosses itself, and the output is one smoothed track. With --bound,
    FILE is a planned track (time, latitude, longitude of its corners), and the output is the smallest error
    that any filter can reach.

    Parameters
    ----------
    files
        The logs of one deployment, with telemetry for dead reckoning; with --bound, the planned track.
    output
        The file to write.
    map
        The anomaly grid. If not given, the field that the log itself measures serves as the map.
    calibration
        The calibration (cal.json). It is not needed for a log with total_field, either corrected or of a
        scalar magnetometer. With --bound, it gives the sensor noise; the default noise is 1 nT.
    config
        A bridge.toml whose [navigation.options] state the uncertainty of start, current and map.
    bound
        Compute the accuracy that the map allows along a planned track.
    sample_interval
        With --bound: time between samples in s. By default that of FILE if it is a log with a magnetometer,
        else that of the calibration, else 4.
    plot
        A PNG, PDF or SVG to write, with the tracks, the map if given, errors and sigma; or with the bound.
    """
    cli.logs_to_read(files, output, map, calibration, config)

    known, options = mb.load(calibration) if calibration else None, _options(config)
    if bound:
        if map is None:
            raise WrongUse(
                "--bound: expected --map, on which the bound depends; without a map, magbridge navigate FILE "
                "--calibration cal.json gives the accuracy of a survey that was flown"
            )
        _bound(files, map, output, options, known, sample_interval, plot, reading, json)
        return
    from magbridge.logs import write
    from magbridge.navigate.batch import navigate as find_way

    deployment = _with_total_field(files, known, calibration, heading_reference, reading)
    options = options or _options_for(deployment, known)
    if map is None:
        from magbridge.navigate.own_survey import localise

        grid, track = None, localise(deployment, options)
    else:
        grid, options = _continued(mb.read_grid(map), options, deployment)
        track = find_way(deployment, grid, options)
    if plot:
        from magbridge.navigate.draw import draw_navigation

        draw_navigation(track, grid, plot)
    write(track, output)
    cli.complain_all(track.attrs["findings"].splitlines())
    cli.print_result(*_judged(track), json, output)


def _options_for(deployment: xr.Dataset, known: mb.Calibration | None) -> NavigationOptions:
    """Return the filter's default options, with the noise and bias of the calibration or else of the log."""
    from magbridge.navigate import NavigationOptions
    from magbridge.navigate.options import informed, with_level

    if known is not None:
        return informed(NavigationOptions(), known, float(deployment["total_field_sigma"].median()))
    level = float(deployment["level_sigma"].median()) if "level_sigma" in deployment else 0.0
    return with_level(NavigationOptions(), level)


def _with_total_field(
    files: tuple[Path, ...],
    known: mb.Calibration | None,
    calibration: Path | None,
    heading_reference: cli.Heading,
    reading: cli.ReadingOptions,
) -> xr.Dataset:
    """Return the logs as one, corrected with `known`, the calibration of the file `calibration`, if given."""
    from magbridge.columns import CHANNELS
    from magbridge.rows import correct_rows

    deployment = cli.read_log(files, reading, heading_reference, CHANNELS if known is not None else ())
    if known is None or calibration is None:
        if "total_field" not in deployment:
            source = deployment.attrs["source"]
            raise WrongUse(f"{source}: expected a column total_field, or --calibration cal.json")
        return deployment
    cli.complain_all(cli.warnings_of(known, calibration))
    cli.note_missing(known, deployment)
    cli.note_settings(deployment.attrs)
    return deployment.assign(correct_rows(mb.Correction(known), deployment).data_vars)


def _judged(track: xr.Dataset) -> tuple[dict[str, Any], str]:
    """Return values and text of a track's accuracy: its sigma, and its error if the truth is known."""
    from magbridge.navigate.findings import errors

    valid, rows = float(track["valid"].mean()), track.sizes["time"]
    sigma = float((track["covariance_nn"] + track["covariance_ee"])[-1]) ** 0.5
    error, reckoned = (float((one**2).mean()) ** 0.5 for one in errors(track))
    judged = isfinite(error)
    off = f"; off by {error:.0f} m RMS, dead reckoning alone by {reckoned:.0f} m" if judged else ""
    facts = {
        "rows": rows,
        "valid": valid,
        "sigma_m": sigma,
        "error_m": error if judged else None,
        "dead_reckoning_error_m": reckoned if judged else None,
        **track.attrs,
    }
    return facts, f"{counted(rows, 'update')}, {valid:.0%} valid, 1-sigma {sigma:.0f} m at the end{off}"


def _bound(
    files: tuple[Path, ...],
    map: Path,  # noqa: A002
    output: Path,
    options: NavigationOptions | None,
    calibration: mb.Calibration | None,
    sample_interval: float | None,
    plot: Path | None,
    reading: cli.ReadingOptions,
    json: bool,
) -> None:
    from magbridge.logs import write
    from magbridge.navigate import NavigationOptions
    from magbridge.navigate.bound import as_dataset, position_bound

    place = ["latitude", "longitude"]
    plan = cli.read_log(files, reading, required=place).dropna("time", subset=place)
    if plan.sizes["time"] < 2:
        raise DataError(
            f"{plan.attrs['source']}: expected a plan of at least two rows with latitude and longitude, got "
            f"{plan.sizes['time']}; give the track's corners"
        )
    grid, options = _continued(mb.read_grid(map), options or NavigationOptions(), plan)
    track = [plan[name].to_numpy().astype(float) for name in ("time", "latitude", "longitude")]
    sigma = calibration.noise.sensor if calibration else 1.0
    sample_interval = sample_interval or _sample_interval(plan, calibration)
    best = position_bound(grid, track[0], track[1], track[2], options, sigma, every=sample_interval)
    result = as_dataset(best, grid)
    result.attrs["findings"] += f", with samples of {sigma:.3g} nT every {sample_interval:.3g} s"
    result.attrs |= {"sample_sigma_nT": sigma, "sample_interval_s": sample_interval}
    write(result, output)
    if plot:
        from magbridge.navigate.draw import draw_bound

        draw_bound(best, grid, plot)
    cli.print_result(result.attrs, result.attrs["findings"], json, output)


def _sample_interval(plan: xr.Dataset, calibration: mb.Calibration | None) -> float:
    """Return the time between samples, s: of a log with a field, else of the calibration, else 4."""
    if plan.sizes["time"] > 2 and {"mag_x", "total_field"} & set(plan.variables):
        return float(plan["time"].diff("time").median())
    if calibration is not None and calibration.noise.interval > 0.0:
        return calibration.noise.interval
    return 4.0


def _continued(
    grid: AnomalyGrid, options: NavigationOptions, deployment: xr.Dataset
) -> tuple[AnomalyGrid, NavigationOptions]:
    """Return the map continued to the deployment's depth, and options with the error of the continuation."""
    from magbridge.navigate.options import at_depth

    there, known = at_depth(grid, options, deployment.get("depth", 0.0))
    if there is not grid and known != options:
        side = "above" if there.altitude > 0.0 else "below"
        cli.complain(
            f"{grid.name}: the map at {round(grid.altitude)} m is continued to {abs(there.altitude):.0f} m "
            f"{side} the surface; short wavelengths are lost, so its error is typically "
            f"{known.map_sigma:.1f} nT over {known.map_length:.0f} m"
        )
    return there, known


def _options(config: Path | None) -> NavigationOptions | None:
    """Return ``[navigation.options]`` of a configuration; None without `config`."""
    from magbridge.navigate import NavigationOptions
    from magbridge.toml import convert, load_toml

    if config is None:
        return None
    section = load_toml(config).get("navigation", {})
    given = section.get("options") if isinstance(section, dict) else None
    if given is None:
        raise ConfigError(config, "navigation.options", "missing key")
    return convert(given, NavigationOptions, config, "navigation.options.")
