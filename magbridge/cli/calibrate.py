"""Calibrate."""

from __future__ import annotations

from dataclasses import replace
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    AS_THEY_SAY,
    Base,
    Heading,
    Output,
    Plot,
    ReadingOptions,
    Whole,
    check_inputs,
    command,
    complain,
    logs_to_read,
    print_result,
)
from magbridge.cli.fits import drifting, fitted, fleet_start, from_fleet, naming, undeclared_columns
from magbridge.cli.remarks import by_base_station, chosen_parameters, note_losses, note_unused_grid
from magbridge.errors import DataError, WrongUse
from magbridge.files import digest
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.fitting.fit import Fit
    from magbridge.calibration.fitting.observations import Observations
    from magbridge.calibration.model import Calibration

__all__ = ["scalar_options"]

MAX_LISTED_CONTRIBUTIONS = 5
"""Contributions to a scalar's reading that the summary lists."""
ALL_COMPASSES = "all"
"""``--compass all``: a calibration for each compass."""


@command("calibrate FILE... --parameter NAME... -o cal.json [OPTIONS]")
def calibrate(  # noqa: PLR0915 - a statement or two for each option
    *files: Path,
    output: Output,
    parameter: tuple[str, ...] = (),
    order: Annotated[Whole, Parameter(validator=validators.Number(gte=1, lte=6))] = 3,
    method: Literal["auto", "survey", "nominal", "cubic", "runs", "horizontal"] = "auto",
    vehicle: str = "",
    grid: Path | None = None,
    base: Base = None,
    reference: Literal["mean", "scalar"] | None = None,
    site_bias: Annotated[float | None, Parameter(validator=validators.Number(gte=0, lte=1e5))] = None,
    position_sigma: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1e5))] = 0.0,
    filter_cutoff: Annotated[float, Parameter(validator=validators.Number(gte=0, lt=inf))] = 0.0,
    fleet: str = "",
    refit: str = "",
    heading_reference: Heading = None,
    scalar: str = "",
    lag: str = "auto",
    lever: str = "",
    plot: Plot = None,
    force: bool = False,
    reading: ReadingOptions = AS_THEY_SAY,
    json: bool = False,
) -> None:
    """Fit a calibration to logs of calibration runs.

    With --compass all, every compass of the logs gets a calibration of its own: cal_0.json, cal_1.json.

    If the data do not support the fit, no file is written, and the exit code is 1; see --force.

    Parameters
    ----------
    files
        The logs of the calibration runs.
    output
        The calibration to write (cal.json).
    parameter
        A column that gives the position of a moving mass, or a current; may be repeated. auto: the log's
        currents, throttles, motors and masses that predict held-out parts better; the command prints by how
        much (method auto).
    order
        Highest total degree of the polynomials in the parameters.
    method
        auto is the one to use: survey where only the main field or a map is known at the log's positions
        (the crustal field is estimated with the calibration), else the fit to a known field. For comparison:
        nominal (one ellipsoid for all positions), cubic (the paper's), runs (an ellipsoid for each run,
        then polynomials through them: the paper's first stage), horizontal (one ellipsoid, levelled by
        roll and pitch: the alternative that the paper names).
    vehicle
        A vehicle.toml with the positions of the moving masses relative to the sensor (method auto); with
        --fleet, the vehicle's name in the fleet, which is known for logs that are catalogued.
    grid
        An anomaly grid to add to the IGRF.
    base
        A base station's log (total_field, or a vector): the Earth's field variation, to add to the reference.
        A log of an observatory (IAGA-2002) among the logs is added in the same way.
    reference
        mean: use the mean length of the log's own readings as the reference, if neither the log nor --date
        gives the Earth's field. The total field then has the sensor's own scale, which site_bias counts: by
        default 2 %. scalar: use the reading of the column that --scalar names, for a scalar magnetometer away
        from the vehicle's iron or compensated already; its column's sigma is site_bias, by default 1 nT.
    site_bias
        1-sigma in nT of a constant error of the reference field over the whole site. By default 0 where
        the log has reference_field, the map's own sigma with --grid (20 if it states none), else 145: what
        main-field models do not reach of the crust (error model of the World Magnetic Model 2020). The
        corrected field's sigma counts it, and level_sigma says how much is common to all samples.
    position_sigma
        1-sigma in m by which dead-reckoned positions slowly drift, where the crustal field is estimated with
        the calibration: the track is corrected to where the field repeats itself; 0: positions are exact.
    filter_cutoff
        Cut-off frequency in Hz of the sensor's first-order anti-alias filter; 0: no filter. The fit undoes
        its attenuation in turns; correct and the bridge then undo its lag in the vector and the heading.
    fleet
        A fleet's catalogue, a folder or postgresql://USER@HOST/DATABASE: the fit starts from the prediction
        of the vehicle's earlier deployments and its fleet, and the command prints the gain (method auto). Two
        runs are then often enough.
    refit
        Which refit it flies with, if its logs are not catalogued; by default a new one.
    scalar
        The column of a scalar magnetometer beside the vector sensor, nT: its compensation by the vector's
        direction and by telemetry is fitted, too, and stands in the same file. The channels are those of
        --parameter; without it, or with auto, all telemetry of the log.
    lag
        Time in s by which the scalar is behind the vector; auto estimates it.
    lever
        Position of the scalar sensor: m forward, starboard and down of the log's positions, as 1.5,0,-0.3.
    plot
        A PNG, PDF or SVG to draw: the error of each sample, raw and corrected, against time, heading and
        each parameter.
    force
        Write the calibration although the data do not support the fit.
    json
        Print the result as JSON, with the paper's M, S and T at the middle of each parameter's range.
    """
    given: dict[str, Any] = dict(locals())
    masses = Path(vehicle) if vehicle and not fleet else None
    _refuse_together(parameter, method, masses, fleet)
    logs_to_read(files, output, masses, grid, base)
    check_inputs((*files, output), plot)
    if reading.compass == ALL_COMPASSES:
        _each_compass(**given)
        return

    from magbridge.calibration.file import save
    from magbridge.calibration.fitting.lowpass import unfiltered
    from magbridge.calibration.fitting.mounted_masses import read_vehicle
    from magbridge.calibration.fitting.observe import observations
    from magbridge.calibration.fitting.parameter_choice import AUTO
    from magbridge.calibration.fitting.sources import unused_logs
    from magbridge.columns import CHANNELS, require
    from magbridge.field.read import read_grid
    from magbridge.field.reference import with_true_heading
    from magbridge.logs import read_each
    from magbridge.logs.deployment import join

    beside = scalar_options(scalar, reference, lag, lever)
    named_channels = tuple(name for name in parameter if name != AUTO)
    start = fleet_start(fleet, vehicle, refit, files) if fleet else None
    parameter = parameter or (start.names if start else ())
    anomalies = read_grid(grid) if grid else None
    with waiting("reading"):
        logs = by_base_station(read_each(files, options=reading.options), base)
        deployment = join(logs)
    require(deployment, (*CHANNELS, *((scalar,) if scalar else ()), *named_channels))
    deployment = with_true_heading(deployment, heading_reference)
    note_losses(deployment.attrs)
    if reference == "mean":
        deployment, site_bias = _about_mean(deployment, site_bias)
    if reference == "scalar":
        deployment = deployment.assign(reference_field=("time", deployment[scalar].to_numpy().astype(float)))
        site_bias = 1.0 if site_bias is None else site_bias
    note_unused_grid(grid, deployment)
    options: dict[str, Any] = {"vehicle": read_vehicle(masses)} if masses else {}
    with naming(deployment), waiting("fitting"):
        parameter = chosen_parameters(parameter, deployment, grid=anomalies, order=order, site_bias=site_bias)
        data = replace(
            observations(deployment, parameter, grid=anomalies),
            inputs=_digests((*files, *reading.sensor_log, *([base] if base else []))),
        )
        for line in unused_logs(logs, data):
            complain(line)
        data = unfiltered(data, filter_cutoff) if filter_cutoff else data
        options |= drifting(position_sigma, data, method)
        if start:
            found, doubt, worth = from_fleet(start, data, order, site_bias=site_bias, **options)
        else:
            found, doubt, worth = *fitted(logs, data, method, order, site_bias=site_bias, **options), {}
    if plot:
        from magbridge.calibration.fitting.draw import draw_fit

        draw_fit(found.calibration, data, plot)
    refused = not (found.supported or force)
    for warning in (*found.warnings[refused:], *doubt, *undeclared_columns(deployment, data, found)):
        complain(warning)
    if refused:
        raise DataError(f"{output}: not written, because {found.warnings[0]}; --force writes it all the same")
    calibration, text = found.calibration, ""
    left_out, facts = deployment.sizes["time"] - len(data), _facts(found, data)
    if scalar and reference != "scalar":
        with waiting("fitting the scalar"):
            known = anomalies is not None or ("reference_field" in deployment and reference is None)
            own = {"grid": anomalies, "map_known": known, **beside}
            calibration, text = _with_scalar(deployment, calibration, scalar, named_channels, facts, own)
    save(calibration, output)
    print_result(
        {"file": str(output), "method": method, **facts, "left_out": left_out, **worth},
        f"{output}: {method}, {_summary(facts)}"
        + (f"; {counted(left_out, 'row')} without every value left out" if left_out else "")
        + text,
        json,
    )


def scalar_options(scalar: str, reference: str | None, lag: str, lever: str) -> dict[str, Any]:
    """Return lag and lever arm as numbers; WrongUse: not numbers, or options without --scalar."""
    if not scalar:
        if reference == "scalar" or lag != "auto" or lever:
            raise WrongUse("--reference scalar, --lag and --lever: give --scalar COLUMN, too")
        return {}
    try:
        behind = None if lag == "auto" else float(lag)
        arm = tuple(float(part) for part in lever.split(",")) if lever else (0.0, 0.0, 0.0)
    except ValueError:
        raise WrongUse(
            f"--lag {lag}, --lever {lever or 0}: expected auto or s, and m as F,R,D such as 1.5,0,-0.3"
        ) from None
    if len(arm) != 3 or not all(map(isfinite, (*arm, behind or 0.0))):
        raise WrongUse(f"--lever {lever}: expected three numbers, F,R,D in m, such as 1.5,0,-0.3")
    return {"lag": behind, "lever": arm}


def _with_scalar(
    deployment: xr.Dataset,
    calibration: Calibration,
    scalar: str,
    names: tuple[str, ...],
    facts: dict[str, Any],
    options: dict[str, Any],
) -> tuple[Calibration, str]:
    """Return the calibration with its scalar sensor, and a summary; add to the facts to print as JSON."""
    from magbridge.calibration.figure_of_merit import merit_text
    from magbridge.calibration.fitting.scalar_log import calibrate_scalar, telemetry_columns

    names = names or telemetry_columns(deployment, scalar)
    fit = calibrate_scalar(deployment, calibration, scalar, names, **options)
    facts["scalar"] = {
        "column": scalar,
        "channels": list(names),
        "rms_before_nT": fit.rms_before,
        "rms_nT": fit.rms_after,
        "contribution_nT": fit.contribution,
        "left_out": fit.left_out,
        "figure_of_merit": fit.merit and {**fit.merit, "fitted": True},
    }
    largest = sorted(fit.contribution.items(), key=lambda one: -one[1])
    parts = ", ".join(
        f"{name} {value:.2g}" for name, value in largest[:MAX_LISTED_CONTRIBUTIONS] if value > 0.0
    )
    text = (
        f"; scalar {scalar}: {fit.rms_before:.2f} -> {fit.rms_after:.2f} nT about the mean with "
        f"{counted(len(names), 'channel')} ({parts} nT)"
    )
    if fit.merit:
        text += f"; {merit_text(fit.merit)} (fitted)"
    return replace(calibration, sensors=(fit.sensor,)), text


def _refuse_together(parameter: tuple[str, ...], method: str, vehicle: Path | None, fleet: str) -> None:
    """WrongUse: options that do not go together."""
    if vehicle and method != "auto":
        raise WrongUse(f"--vehicle: method {method} does not use the positions of the masses; auto does")
    if "auto" in parameter and (method != "auto" or fleet or vehicle):
        raise WrongUse("--parameter auto: goes with method auto, and without --vehicle and --fleet")
    if fleet and method != "auto":
        raise WrongUse("--fleet: goes with method auto")


def _about_mean(deployment: xr.Dataset, site_bias: float | None) -> tuple[xr.Dataset, float]:
    """Return a log with a reference that is its own mean, and how well that is known, nT.

    WrongUse: the log tells the true field.
    """
    from magbridge.columns import counts_from_boot
    from magbridge.estimation.priors import GAIN_SIGMA
    from magbridge.field.reference import about_mean

    source = deployment.attrs["source"]
    placed = {"latitude", "longitude"} <= set(deployment.data_vars) and not counts_from_boot(deployment)
    if placed or "reference_field" in deployment:
        raise WrongUse(f"--reference mean: {source} tells what the field was")
    deployment = about_mean(deployment)
    mean = float(deployment["reference_field"][0])
    complain(
        f"{source}: fitted about a mean of {mean:.0f} nT, since nothing tells what the Earth's field was"
    )
    return deployment, GAIN_SIGMA * mean if site_bias is None else site_bias


def _compass_path(path: Path, compass: int) -> Path:
    """Return the name of a file for one of several compasses."""
    return path.with_name(f"{path.stem}_{compass}{path.suffix}")


def _each_compass(
    files: tuple[Path, ...], output: Path, plot: Path | None, reading: ReadingOptions, **options: Any
) -> None:
    """Calibrate every compass of the logs; DataError: not one could be."""
    from magbridge.logs import read_each
    from magbridge.logs.compasses import compasses_in

    first = replace(reading, compass=None)
    with waiting("reading"):
        found = {one.number for log in read_each(files, options=first.options) for one in compasses_in(log)}
    failed = 0
    for number in sorted(found) or [0]:
        own: dict[str, Any] = {
            "output": _compass_path(output, number),
            "plot": plot and _compass_path(plot, number),
        }
        try:
            calibrate(*files, reading=replace(reading, compass=str(number)), **own, **options)
        except DataError as error:
            failed += 1
            complain(f"compass {number}: {error}")
    if failed == max(len(found), 1):
        raise DataError(f"{files[0]}: not one of its compasses could be calibrated")


def _facts(found: Fit, data: Observations) -> dict[str, Any]:
    from magbridge.calibration.fitting.validate import expected_heading_sigma
    from magbridge.calibration.paper import facts

    sigma = expected_heading_sigma(found.calibration, data)
    return {
        "samples": len(data),
        "heading_sigma_deg": sigma if isfinite(sigma) else None,
        "rms_nT": found.rms,
        "supported": found.supported,
        "scales": found.scales,
        "noise_nT": found.calibration.noise.sensor,
        "warnings": found.warnings,
        "paper": facts(found.calibration),
    }


def _summary(facts: dict[str, Any]) -> str:
    from magbridge.calibration.heading import DEFAULT_TILT_SIGMA_DEG

    low, high = facts["scales"]
    text = (
        f"{facts['samples']} samples, {facts['rms_nT']:.2f} nT RMS in the sensor's own units, "
        f"with scales of {low:.3f} to {high:.3f}"
    )
    if (sigma := facts["heading_sigma_deg"]) is None:
        return f"{text}; no heading, which needs roll and pitch in the log at several pitch angles"
    tilt = f"with roll and pitch good to {DEFAULT_TILT_SIGMA_DEG:g} deg"
    return f"{text}; magnetic heading {sigma:.2f} deg (1-sigma, {tilt})"


def _digests(files: tuple[Path, ...]) -> dict[str, str]:
    """Return each file's name (its path where another has that name) and digest; warn of identical files."""
    seen: dict[str, Path] = {}
    for file in files:
        first = seen.setdefault(digest(file), file)
        if first is not file:
            complain(f"{file}: identical to {first}; its samples are counted once")
    names = [file.name for file in seen.values()]
    return {str(file) if names.count(file.name) > 1 else file.name: key for key, file in seen.items()}
