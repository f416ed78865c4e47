"""Define the command ``calibrate``, which fits a calibration to logs of calibration runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import CalibrationError, DataError, WrongUse
from magbridge.files import digest
from magbridge.progress import waiting
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.fitting.fit import Fit
    from magbridge.calibration.fitting.observations import Observations
    from magbridge.field.grid import AnomalyGrid
    from magbridge.fleet.memory import FleetPrediction

MAX_LISTED_CONTRIBUTIONS = 5
"""Largest number of contributions to a scalar magnetometer's reading that the summary lists."""
ALL_COMPASSES = "all"
"""Value of ``--compass`` that requests a calibration of each compass."""

SCALAR_REFERENCE_SIGMA_NT = 1.0
"""Default 1-sigma of a scalar magnetometer's reading as the reference field, nT."""


@Parameter(name="*")
@dataclass(frozen=True)
class ModelOptions:
    """Options for the method of the fit, and for knowledge about the vehicle.

    Parameters
    ----------
    method
        Use auto. If only the main field or a map is known, auto uses survey, which estimates the crustal
        field with the calibration; else it fits to the known field. For comparison: nominal (one ellipsoid),
        cubic (the paper's method), runs (the paper's first stage: an ellipsoid for each run), horizontal (one
        ellipsoid, levelled by roll and pitch).
    vehicle
        A vehicle.toml with the positions of the moving masses relative to the sensor (method auto). With
        --fleet: the vehicle's name in the fleet, by default from the catalogue's entries for the logs.
    filter_cutoff
        Cut-off frequency in Hz of the sensor's first-order anti-alias filter; 0: no filter. The fit undoes
        its attenuation; correct and the bridge undo its lag.
    fleet
        The catalogue of a fleet, a folder or postgresql://USER@HOST/DATABASE. The prior of the fit is then
        the prediction from the vehicle's earlier deployments and its fleet (method auto), so that two runs
        are often enough.
    refit
        With --fleet: name of the vehicle's refit, if the logs are not catalogued; by default a new one.
    """

    method: Literal["auto", "survey", "nominal", "cubic", "runs", "horizontal"] = "auto"
    vehicle: str = ""
    filter_cutoff: Annotated[float, Parameter(validator=validators.Number(gte=0, lt=inf))] = 0.0
    fleet: str = ""
    refit: str = ""

    @property
    def masses(self) -> Path | None:
        """Path of the vehicle.toml; None if it is not given."""
        return Path(self.vehicle) if self.vehicle and not self.fleet else None

    def check(self, parameter: tuple[str, ...]) -> None:
        """Check that the options are compatible with each other and `parameter`; WrongUse: they are not."""
        if self.masses and self.method != "auto":
            raise WrongUse(f"--vehicle: expected --method auto, got {self.method}, which has no use for it")
        if "auto" in parameter and (self.method != "auto" or self.fleet or self.masses):
            raise WrongUse("--parameter auto: expected --method auto without --vehicle, --fleet; name them")
        if self.fleet and self.method != "auto":
            raise WrongUse(f"--fleet: expected --method auto, got {self.method}; leave one of them out")


@Parameter(name="*")
@dataclass(frozen=True)
class ReferenceOptions:
    """Options for the reference field and the heading reference.

    Parameters
    ----------
    grid
        An anomaly grid to add to the IGRF.
    reference
        mean: the mean of the log's own readings, if the Earth's field is not known; site_bias is then by
        default 2 % of the mean. scalar: the column of --scalar, if that magnetometer is compensated or far
        from the vehicle's iron; site_bias is then its sigma, by default 1 nT.
    site_bias
        1-sigma in nT of a constant error of the reference field over the whole site; sigma and level_sigma
        include it. By default 0 if the log has reference_field, the map's sigma with --grid (20 if the map
        states none), else 138 (error model of the World Magnetic Model 2025).
    """

    grid: Path | None = None
    reference: Literal["mean", "scalar"] | None = None
    site_bias: Annotated[float | None, Parameter(validator=cli.fit_range("site_bias"))] = None
    heading_reference: cli.Heading = None

    def apply(self, deployment: xr.Dataset, scalar: str) -> tuple[xr.Dataset, float | None]:
        """Return the log with its reference field, and the 1-sigma of its level, nT (None: default)."""
        if self.reference == "mean":
            return _about_mean(deployment, self.site_bias)
        if self.reference == "scalar":
            values = deployment[scalar].to_numpy().astype(float)
            sigma = SCALAR_REFERENCE_SIGMA_NT if self.site_bias is None else self.site_bias
            return deployment.assign(reference_field=("time", values)), sigma
        return deployment, self.site_bias


PHYSICAL_MODEL = ModelOptions()
MAIN_FIELD = ReferenceOptions()
"""`PHYSICAL_MODEL`, `MAIN_FIELD`: Defaults: method auto, and the reference field of the log or the IGRF."""


@dataclass
class _Request:
    """Arguments of ``calibrate`` for one compass."""

    files: tuple[Path, ...]
    output: Path
    fit: cli.FitOptions
    model: ModelOptions
    truth: ReferenceOptions
    scalar: cli.ScalarOptions
    plot: Path | None
    force: bool
    reading: cli.ReadingOptions
    anomalies: AnomalyGrid | None

    def of_compass(self, number: int) -> _Request:
        """Return the arguments for the compass `number`; the names of written files then contain it."""

        def numbered(path: Path) -> Path:
            return path.with_name(f"{path.stem}_{number}{path.suffix}")

        return replace(
            self,
            output=numbered(self.output),
            plot=self.plot and numbered(self.plot),
            reading=replace(self.reading, compass=str(number)),
        )


@cli.command("calibrate FILE... --parameter NAME... -o cal.json [OPTIONS]")
def calibrate(
    *files: Path,
    output: cli.CalibrationOutput,
    fit: cli.FitOptions = cli.NO_PARAMETERS,
    model: ModelOptions = PHYSICAL_MODEL,
    truth: ReferenceOptions = MAIN_FIELD,
    scalar: cli.ScalarOptions = cli.NO_SCALAR,
    plot: cli.Plot = None,
    force: bool = False,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: bool = False,
) -> None:
    """Fit a calibration to logs of calibration runs.

    With --compass all, a calibration is written for each compass of the logs: cal_0.json, cal_1.json.

    If the data do not support the fit, no file is written, and the exit code is 1; see --force.

    Parameters
    ----------
    files
        The logs of the calibration runs.
    output
        The calibration to write (cal.json).
    plot
        A PNG, PDF or SVG to write, with the error of each sample, raw and corrected, against time, heading
        and each parameter.
    force
        Write the calibration even if the data do not support the fit.
    json
        Print the result, or the error, as one JSON object, with the paper's M, S and T at the middle of each
        parameter's range. With --compass all, one result for each compass.
    """
    model.check(fit.parameter)
    scalar.check(is_reference=truth.reference == "scalar")
    cli.logs_to_read(files, output, model.masses, truth.grid, fit.base)
    cli.without_dask()

    anomalies = mb.read_grid(truth.grid) if truth.grid else None
    request = _Request(files, output, fit, model, truth, scalar, plot, force, reading, anomalies)
    results = _each_compass(request) if reading.compass == ALL_COMPASSES else {"": _calibrate(request)}
    facts: dict[str, Any] = {number: found for number, (found, _) in results.items()}
    text = "\n".join(sentence for _, sentence in results.values())
    cli.print_result(facts.get("", {"compasses": facts}), text, json)


def _calibrate(request: _Request) -> tuple[dict[str, Any], str]:
    """Fit and write the calibration of one compass; return the result as values for JSON and as text."""
    from magbridge.columns import CHANNELS, require
    from magbridge.field.reference import with_true_heading
    from magbridge.logs import read_each
    from magbridge.logs.deployment import join, refuse_repeated

    model, truth, scalar = request.model, request.truth, request.scalar.scalar
    start = None
    if model.fleet:
        from magbridge.fleet.memory import start as predict

        with waiting("learning"):
            logs_digests = {digest(file) for file in request.files}
            start = predict(model.fleet, model.vehicle, model.refit, logs_digests)
    with waiting("reading"):
        options = request.reading.options
        logs = cli.by_base_station(read_each(request.files, options=options), request.fit.base)
        deployment = join(logs)
        if options.strict:
            refuse_repeated(deployment)
    require(deployment, (*CHANNELS, *((scalar,) if scalar else ()), *request.fit.named))
    deployment = with_true_heading(deployment, truth.heading_reference)
    cli.note_losses(deployment.attrs)
    deployment, site_bias = truth.apply(deployment, scalar)
    cli.note_unused_grid(truth.grid, deployment)
    found, data, worth = _fit(request, logs, deployment, site_bias, start)
    if request.plot:
        from magbridge.plot import draw_fit

        draw_fit(found.calibration, data, request.plot)
    if not found.supported:
        _refuse(request, found.warnings[0].text)
    calibration, facts, text = found.calibration, _facts(found, data), ""
    if scalar and truth.reference != "scalar":
        with waiting("fitting the scalar"):
            calibration, text = _with_scalar(request, deployment, calibration, facts)
    mb.save(calibration, request.output)
    left_out = deployment.sizes["time"] - len(data)
    rows = f"; {counted(left_out, 'row')} without every value left out" if left_out else ""
    facts = {"file": str(request.output), "method": model.method, **facts, "left_out": left_out, **worth}
    return facts, f"{request.output}: {model.method}, {_summary(facts)}{rows}{text}"


def _refuse(request: _Request, reason: str) -> None:
    """Do nothing with --force; otherwise DataError, and no file is written."""
    if not request.force:
        raise DataError(f"{request.output}: not written, because {reason}; --force writes it all the same")


def _fit(
    request: _Request,
    logs: list[xr.Dataset],
    deployment: xr.Dataset,
    site_bias: float | None,
    start: FleetPrediction | None,
) -> tuple[Fit, Observations, dict[str, Any]]:
    """Return the fit, its samples and the benefit of a fleet's prior; print the warnings to stderr."""
    from magbridge.calibration.fitting.observations import unfiltered
    from magbridge.calibration.fitting.observe import observations
    from magbridge.calibration.fitting.pose import read_vehicle
    from magbridge.calibration.fitting.sources import unused_logs

    model, asked, anomalies = request.model, request.fit, request.anomalies
    names, order = asked.parameter or (start.names if start else ()), asked.order
    options: dict[str, Any] = asked.drift
    if model.masses:
        options["vehicle"] = read_vehicle(model.masses)
    with cli.naming(deployment), waiting("fitting"):
        names = cli.chosen_parameters(names, deployment, grid=anomalies, order=order, site_bias=site_bias)
        read = (*request.files, *request.reading.sensor_log, *filter(None, [asked.base]))
        data = replace(observations(deployment, names, grid=anomalies), inputs=_digests(read))
        cli.complain_all(unused_logs(logs, data))
        data = unfiltered(data, model.filter_cutoff) if model.filter_cutoff else data
        if start:
            found, remarks, worth = _from_fleet(start, data, order, site_bias=site_bias, **options)
        else:
            found, remarks = _fitted(logs, data, model.method, order, site_bias=site_bias, **options)
            worth = {}
    refused = not (found.supported or request.force)
    cli.complain_all((*found.warnings[refused:], *remarks, *_undeclared_columns(deployment, data, found)))
    return found, data, worth


def _fitted(
    logs: list[xr.Dataset], data: Observations, method: str, order: int, **options: Any
) -> tuple[Fit, list[str]]:
    """Return the fit, and a list with a warning if several logs appear to be of different vehicles."""
    from magbridge.calibration.fitting.sources import heterogeneous_logs

    def refitted(part: Observations) -> Fit:
        return mb.fit(part, method, order)

    try:
        found = mb.fit(data, method, order, **options)
    except CalibrationError as error:
        if reason := heterogeneous_logs(logs, data, None, refitted):
            raise CalibrationError(reason.text) from error
        raise
    reason = heterogeneous_logs(logs, data, found, refitted)
    return found, [reason.text] if reason else []


def _from_fleet(
    start: FleetPrediction, data: Observations, order: int, **options: Any
) -> tuple[Fit, list[str], dict[str, Any]]:
    """Return the fit with a fleet's prior, and its benefit over a fit without it, as lines and as values."""
    from magbridge.fleet.memory import gained

    found = mb.fit(data, order=order, known=start.known, **options)
    try:
        alone = mb.fit(data, order=order, **options)
    except CalibrationError:
        alone = None
    facts, lines = gained(found, alone, start)
    return found, lines, {"fleet": facts}


def _undeclared_columns(deployment: xr.Dataset, data: Observations, found: Fit) -> list[str]:
    """Return a warning for each column of the log that affects the field but is not a parameter."""
    import numpy as np

    from magbridge.calibration.fitting.parameter_choice import undeclared
    from magbridge.logs.info import telemetry

    rows = np.searchsorted(deployment["time"].to_numpy(), data.time)
    others = [name for name in telemetry(deployment) if name not in data.names]
    return undeclared(found.calibration, data, {name: deployment[name].to_numpy()[rows] for name in others})


def _with_scalar(
    request: _Request, deployment: xr.Dataset, calibration: mb.Calibration, facts: dict[str, Any]
) -> tuple[mb.Calibration, str]:
    """Return the calibration with its scalar sensor, and a summary; add the results to `facts` for JSON."""
    from magbridge.calibration.figure_of_merit import merit_text
    from magbridge.calibration.fitting.scalar_log import calibrate_scalar, telemetry_columns

    scalar, truth = request.scalar, request.truth
    names = request.fit.named or telemetry_columns(deployment, scalar.scalar)
    is_known = request.anomalies is not None or ("reference_field" in deployment and truth.reference is None)
    fit = calibrate_scalar(
        deployment, calibration, scalar.scalar, names, grid=request.anomalies, map_known=is_known,
        lag=scalar.lag_s, lever=scalar.lever_m or (0.0, 0.0, 0.0),
    )  # fmt: skip
    if fit.doubt:
        _refuse(request, fit.doubt)
        cli.complain(fit.doubt)
    facts["scalar"] = {
        "column": scalar.scalar,
        "channels": list(names),
        "rms_before_nT": fit.rms_before,
        "rms_nT": fit.rms_after,
        "contribution_nT": fit.contribution,
        "left_out": fit.left_out,
        "lag_s": fit.sensor.lag,
        "lag_sigma_s": fit.lag_sigma,
        "findings": [finding.text for finding in fit.findings],
        "figure_of_merit": fit.merit and {**fit.merit, "fitted": True},
    }
    largest = sorted(fit.contribution.items(), key=lambda one: -one[1])[:MAX_LISTED_CONTRIBUTIONS]
    parts = ", ".join(f"{name} {value:.2g}" for name, value in largest if value > 0.0)
    text = (
        f"; scalar {scalar.scalar}: {fit.rms_before:.2f} -> {fit.rms_after:.2f} nT about the mean with "
        f"{counted(len(names), 'channel')} ({parts} nT)"
    )
    if fit.merit:
        text += f"; {merit_text(fit.merit)} (fitted)"
    text += "".join(f"; {finding.text}" for finding in fit.findings[:MAX_LISTED_CONTRIBUTIONS])
    doubts = (*calibration.warnings, fit.doubt) if fit.doubt else calibration.warnings
    return replace(calibration, sensors=(fit.sensor,), warnings=doubts), text


def _about_mean(deployment: xr.Dataset, site_bias: float | None) -> tuple[xr.Dataset, float]:
    """Return a log with its mean reading as the reference field, and the 1-sigma of the reference, nT."""
    from magbridge.columns import counts_from_boot
    from magbridge.estimation.priors import GAIN_SIGMA
    from magbridge.field.reference import about_mean

    source = deployment.attrs["source"]
    placed = {"latitude", "longitude"} <= set(deployment.data_vars) and not counts_from_boot(deployment)
    if placed or "reference_field" in deployment:
        raise WrongUse(f"--reference mean: {source} has positions or reference_field; leave the option out")
    deployment = about_mean(deployment)
    mean = float(deployment["reference_field"][0])
    cli.complain(f"{source}: the Earth's field is unknown; the reference is the mean reading, {mean:.0f} nT")
    return deployment, GAIN_SIGMA * mean if site_bias is None else site_bias


def _each_compass(request: _Request) -> dict[str, tuple[dict[str, Any], str]]:
    """Calibrate every compass of the logs; return number -> values and text of the result."""
    from magbridge.logs import read_each
    from magbridge.logs.compasses import compasses_in

    first = replace(request.reading, compass=None)
    with waiting("reading"):
        logs = read_each(request.files, options=first.options)
        numbers = {one.number for log in logs for one in compasses_in(log)} or {0}
    results: dict[str, tuple[dict[str, Any], str]] = {}
    for number in sorted(numbers):
        try:
            results[str(number)] = _calibrate(request.of_compass(number))
        except DataError as error:
            cli.complain(f"compass {number}: {error}")
    if not results:
        raise DataError(f"{request.files[0]}: none of {len(numbers)} compasses can be calibrated; see above")
    return results


def _facts(found: Fit, data: Observations) -> dict[str, Any]:
    from magbridge.calibration.fitting.uncertainty import expected_heading_sigma
    from magbridge.calibration.model import facts

    sigma, boresight = expected_heading_sigma(found.calibration, data), found.calibration.boresight
    return {
        "samples": len(data),
        "heading_sigma_deg": sigma if isfinite(sigma) else None,
        "tilt_sigma_deg": boresight.tilt_sigma if boresight is not None else None,
        "rms_nT": found.rms,
        "supported": found.supported,
        "scales": found.scales,
        "noise_nT": found.calibration.noise.sensor,
        "warnings": [warning.text for warning in found.warnings],
        "warning_codes": [warning.code for warning in found.warnings],
        "paper": facts(found.calibration),
    }


def _summary(facts: dict[str, Any]) -> str:
    low, high = facts["scales"]
    text = (
        f"{facts['samples']} samples, {facts['rms_nT']:.2f} nT RMS in the sensor's own units, "
        f"with scales of {low:.3f} to {high:.3f}"
    )
    if (sigma := facts["heading_sigma_deg"]) is None:
        return f"{text}; no heading, which needs roll and pitch in the log at several pitch angles"
    tilt = f"with roll and pitch good to {facts['tilt_sigma_deg']:.2f} deg"
    return f"{text}; magnetic heading {sigma:.2f} deg (1-sigma, {tilt})"


def _digests(files: tuple[Path, ...]) -> dict[str, str]:
    """Return file name (path if two names are equal) -> SHA-256; print a warning about identical files."""
    seen: dict[str, Path] = {}
    for file in files:
        first = seen.setdefault(digest(file), file)
        if first is not file:
            cli.complain(f"{file}: has the same content as {first}; its samples are used once")
    names = [file.name for file in seen.values()]
    return {str(file) if names.count(file.name) > 1 else file.name: key for key, file in seen.items()}
