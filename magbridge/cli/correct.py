"""Define the commands ``correct`` and ``export``, which apply or convert a calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.columns import CHANNELS, CORRECTED, usual
from magbridge.errors import ConfigError, DataError, WrongUse
from magbridge.progress import track
from magbridge.records import Quality
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.config import Config
    from magbridge.learning import Learner


COPIED_COLUMNS = (
    *("latitude", "longitude", "depth", "roll", "pitch", "heading", "run", "dive", "line", "line_type"),
    *("sensor_temperature", "reference_field", "velocity_north", "velocity_east", "water_speed"),
    *("local_north", "local_east", "dr_latitude", "dr_longitude", "gps_latitude", "gps_longitude"),
    *("truth_latitude", "truth_longitude"),
)
"""Columns of a log that are copied to the output, in addition to the calibration's parameters."""


@cli.command("correct FILE... --calibration cal.json -o FILE [OPTIONS]")
def correct(
    *files: Path,
    calibration: Path | None = None,
    output: cli.Log,
    learn: bool = False,
    config: Path | None = None,
    save: cli.SavedCalibration = None,
    plot: cli.Plot = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Correct a log with a calibration, as the bridge would have done live.

    A bridge's own log has a row for each reading, with the latest telemetry and its age, and the settings
    with which the bridge started. In any other log, every telemetry value counts as new, and the output omits
    rows without a reading. To get the bridge's output bit for bit, run
    magbridge replay LOG --config bridge.toml --log DIR.

    Parameters
    ----------
    files
        The logs of one deployment.
    calibration
        The calibration (cal.json); with --config by default the bridge's calibration.
    output
        The file to write: total field and sigma, vector, anomaly, flags, the compensated scalar if the
        calibration has a scalar sensor, and the log's position, depth, attitude and parameters.
    learn
        Update the calibration during the run, as a bridge with [learning] does; the log needs positions.
    config
        With --learn: the bridge.toml with [learning]; its calibration, if given, is the first calibration.
    save
        With --learn: a file (cal.json) for the calibration that was published last.
    plot
        A PNG, PDF or SVG to write, with the corrected field, its 2-sigma band, and the flagged samples.
    """
    for option, given in (("--config", config), ("--save", save)):
        if given is not None and not learn:
            raise WrongUse(f"{option}: expected --learn with it, because only learning uses it; add --learn")
    source = calibration or config
    if source is None:
        raise WrongUse("expected --calibration cal.json, or --learn with --config bridge.toml")
    cli.logs_to_read(files, output, source, reading.columns)
    cli.without_dask()

    from magbridge.logs import Writer, read_chunks

    known, settings = _known(calibration, config)
    cli.complain_all(cli.warnings_of(known, source))
    correction: mb.Correction | None = None
    pieces: list[dict[str, Any]] = []
    kept: list[xr.Dataset] = []
    rows = 0
    with Writer(output) as writer:
        parts = track(read_chunks(files, required=CHANNELS, options=reading.options), "correcting")
        done = _corrected(parts, files, known, source, settings if learn else None)
        for part, corrected, correction in _scalar_too(done, known):
            writer.append(corrected)
            _notify(correction)
            pieces.append(part.attrs)
            rows += part.sizes["time"]
            kept.append(corrected[list(CORRECTED) if plot else ["quality", "total_field"]])
    if plot:
        from magbridge.logs.deployment import join
        from magbridge.plot import draw_corrected

        draw_corrected(join(kept), plot)
    cli.note_losses(*pieces)
    cli.note_settings(*pieces)
    facts, summary = _counts(kept, rows, source)
    if correction is not None and correction.learner is not None:
        summary += _keep_learned(correction.learner, known, facts, save)
    cli.print_result(facts, summary, json, output)


def _scalar_too(
    pieces: Iterator[tuple[xr.Dataset, xr.Dataset, mb.Correction]], known: mb.Calibration
) -> Iterator[tuple[xr.Dataset, xr.Dataset, mb.Correction]]:
    """Yield (log, corrected, correction) of each piece, with the compensated scalar if calibrated."""
    if not known.sensors:
        yield from pieces
        return
    # joined, because the compensation needs the range of each channel over the whole log
    from magbridge.calibration.fitting.scalar_log import with_scalar
    from magbridge.logs.deployment import join

    logs, corrected, correction = zip(*pieces, strict=True)
    log = join(logs)
    yield log, with_scalar(join(corrected), log, known.sensors), correction[-1]


def _known(file: Path | None, config: Path | None) -> tuple[mb.Calibration, Config]:
    """Return the first calibration and the settings of the bridge; without `config`, default settings."""
    from magbridge.bridge.learning import first_calibration
    from magbridge.config import Config, Learning, Link, Sensor
    from magbridge.config import load as load_config

    if config is None:
        assert file is not None
        nobody = Sensor(driver="", port="-"), Link(url="-")
        settings = Config(*nobody, learning=Learning(), path=file)
    else:
        settings = load_config(config)
        if settings.learning is None:
            raise ConfigError(config, "learning", "missing")
    known = mb.load(file) if file is not None else first_calibration(settings)
    assert known is not None
    return known, settings


def _corrected(
    parts: Iterable[xr.Dataset],
    files: tuple[Path, ...],
    known: mb.Calibration,
    file: Path,
    learn: Config | None,
) -> Iterator[tuple[xr.Dataset, xr.Dataset, mb.Correction]]:
    """Yield each piece of a log, its corrected samples, and the correction."""
    from magbridge.field.reference import missing_anomaly
    from magbridge.rows import correct_rows

    correction, whole, lack = None, False, ""
    for part in parts:
        if correction is None:
            cli.note_missing(known, part)
            correction = mb.Correction(known, learner=_learner(known, part, learn) if learn else None)
        if not lack and (lack := missing_anomaly(part)):
            cli.complain(f"{part.attrs['source']}: {lack}")
        sampled = part[list(CHANNELS)].to_array().notnull()
        corrected = _with_columns(part, correct_rows(correction, part), known, file)
        yield part, corrected.isel(time=sampled.any("variable").to_numpy()), correction
        whole = whole or bool(sampled.all("variable").any())
    if not whole:
        names = ", ".join(map(str, files))
        raise DataError(f"{names}: expected rows with all of {' '.join(CHANNELS)}, got none")


def _learner(known: mb.Calibration, log: xr.Dataset, settings: Config) -> Learner:
    """Return a learner with the bridge's settings; without ``[telemetry]`` it uses the log's currents."""
    from magbridge.bridge.learning import open_learner

    currents = tuple(str(key) for key in log.data_vars if usual(str(log[key].attrs.get("units", ""))) == "A")
    learner = open_learner(settings, known, None if settings.telemetry else currents)
    assert learner is not None
    return learner


def _notify(correction: mb.Correction) -> None:
    """Print the messages about quality flags and learning to stderr, and delete them."""
    cli.complain_all(correction.notices)
    correction.notices.clear()
    if correction.learner is not None:
        cli.complain_all(f"{notice.text}, {notice.date}" for notice in correction.learner.notices)
        correction.learner.notices.clear()


def _keep_learned(learner: Learner, known: mb.Calibration, facts: dict[str, Any], file: Path | None) -> str:
    """Write the last published calibration to `file`, add results to `facts`, and return a summary."""
    from magbridge.calibration.file import calibration_id, save

    if file is not None:
        save(learner.calibration, file)
    state, name = learner.state, f"{calibration_id(learner.calibration):08x}"
    facts |= {
        "learned_samples": state.learned_samples,
        "calibration_id": name,
        "changed": learner.calibration is not known,
        "unexplained": list(state.causes),
    }
    return f"; {state.learned_samples} learned from, calibration {name} at last"


def _with_columns(log: xr.Dataset, corrected: xr.Dataset, known: mb.Calibration, file: Path) -> xr.Dataset:
    """Return the corrected columns with the copied columns and attributes of the log."""
    from magbridge.calibration.file import calibration_id
    from magbridge.logs.deployment import HISTORY_ATTRIBUTE, MEANING, lasting

    names = [name for name in (*COPIED_COLUMNS, *known.channels) if name in log and name not in corrected]
    made = f"corrected with {file.name}, calibration {calibration_id(known):08x}"
    history = [*str(log.attrs.get(HISTORY_ATTRIBUTE, "")).splitlines(), made]
    attrs = {"calibration_id": f"{calibration_id(known):08x}", HISTORY_ATTRIBUTE: "\n".join(history)}
    meaning = {name: value for name, value in lasting(log.attrs).items() if name in MEANING}
    kept = {name: log[name] for name in names}
    if "heading" in corrected and "heading" in log:
        kept["vehicle_heading"] = _from_true_north(log, corrected)
        meaning = {name: value for name, value in meaning.items() if name != "heading_reference"}
    return corrected.assign(kept).assign_attrs(meaning | attrs)


def _from_true_north(log: xr.Dataset, corrected: xr.Dataset) -> xr.DataArray:
    """Return the log's heading, from true north where its attributes say magnetic."""
    heading = log["heading"]
    if log.attrs.get("heading_reference") != "magnetic":
        return heading
    turned = (heading + corrected["declination"]) % 360.0
    return turned.assign_attrs(heading.attrs)


def _counts(corrected: list[xr.Dataset], rows: int, source: Path) -> tuple[dict[str, Any], str]:
    """Return the counts of the samples and flags of a log of `rows` rows, for JSON and as a sentence."""
    import numpy as np

    from magbridge.field.reference import MAIN_FIELD_RANGE_NT

    of_total = ~Quality.NO_BORESIGHT  # NO_BORESIGHT concerns only the vector
    quality = np.concatenate([part["quality"].to_numpy() for part in corrected]).astype(int)
    total = np.concatenate([part["total_field"].to_numpy() for part in corrected])
    samples, flagged = len(quality), int((quality & of_total != 0).sum())
    left_out = rows - samples
    flags = +Counter({flag.names(): int((quality & flag != 0).sum()) for flag in of_total})
    low, high = MAIN_FIELD_RANGE_NT
    unearthly = int(((total < low) | (total > high)).sum())
    if unearthly > samples / 2:
        cli.complain(
            f"{source}: {unearthly} of {samples} corrected total fields are outside the Earth's range, "
            f"{low:,.0f} to {high:,.0f} nT; use the calibration of this vehicle"
        )
    text = f"{counted(samples, 'sample')}, {flagged} of them flagged"
    if flags:
        text += f" ({', '.join(f'{name} {count}' for name, count in flags.items())})"
    if left_out:
        text += f"; {counted(left_out, 'row')} without any of {' '.join(CHANNELS)} left out"
    return {"rows": samples, "flagged": flagged, "flags": flags, "left_out": left_out}, text


COMPASS_COUNT_NT = 100.0
"""Field of one count in most compasses of Seagliders, nT."""


@cli.command(
    "export cal.json --c DIR | --ardupilot F.param | --px4 F.params | --seaglider F.cal | --table F.csv"
)
def export(
    calibration: Path,
    /,
    *,
    c: Annotated[cli.Folder | None, Parameter(name="--c")] = None,
    ardupilot: Annotated[Path | None, Parameter(validator=cli.file_to_write(".param", ".parm"))] = None,
    px4: Annotated[Path | None, Parameter(validator=cli.file_to_write(".params"))] = None,
    number: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=0, lte=3))] = 0,
    seaglider: Annotated[Path | None, Parameter(validator=cli.file_to_write(".cal"))] = None,
    nt_per_count: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=1e5))] = COMPASS_COUNT_NT,
    table: Annotated[Path | None, Parameter(validator=cli.file_to_write(".csv"))] = None,
    parameter: str = "",
    dip: Annotated[float, Parameter(validator=validators.Number(gt=-90, lt=90))] = 60.0,
    json: cli.Json = False,
) -> None:
    """Write a calibration for other programs, and report the parts that their files cannot hold.

    Parameters
    ----------
    calibration
        The calibration (cal.json).
    c
        A folder for magbridge_calibration.h and .c (C99, no allocation), and magbridge_scalar.h and .c.
    ardupilot
        A .param file for ArduPilot: offsets, diagonals, off-diagonals and motor-current compensation of a
        compass.
    px4
        A parameter file (.params) of QGroundControl with the same parameters for PX4.
    number
        Number of the compass in the autopilot, from 0.
    seaglider
        A file with the compass coefficients (tcm2mat.cal) of a Seaglider: one offset and one matrix, with the
        boresight.
    nt_per_count
        For --seaglider: field in nT of one count of its compass, 100 for most types, 56 for type 4.
    table
        A table (.csv) of offset and matrix at positions of one mass, for loggers that accept such a table.
    parameter
        For --table: name of the mass; by default the first parameter.
    dip
        For --seaglider: inclination of the Earth's field in deg, for the reported heading error.
    """
    if not any((c, ardupilot, px4, seaglider, table)):
        raise WrongUse("expected a file: --c DIR, --ardupilot F, --px4 F, --seaglider F or --table F")

    from magbridge.calibration.export_compass import position_table
    from magbridge.errors import CalibrationError
    from magbridge.files import atomic_path, new_folder

    known = mb.load(calibration)
    cli.complain_all(cli.warnings_of(known, calibration))
    if cutoff_hz := known.sensor.filter_cutoff:
        cli.complain(f"{calibration}: no export undoes the sensor's filter of {cutoff_hz:g} Hz")
    texts: dict[Path, str] = {}
    try:
        if c is not None:
            texts |= _in_c(known, c)
        if seaglider is not None:
            texts[seaglider] = _seaglider(calibration, known, nt_per_count, dip)
        if table is not None:
            first = known.parameters[0].name if known.parameters else ""
            texts[table] = position_table(known, parameter or first)
    except CalibrationError as error:
        raise DataError(f"{calibration}: {error}") from error
    texts |= _autopilot(calibration, known, ardupilot, px4, number)
    for file, text in texts.items():
        with new_folder(file.parent), atomic_path(file) as path:
            path.write_text(text, encoding="utf-8")
    files = [str(file) for file in texts]
    cli.print_result({"files": files}, "\n".join(f"{file}: written" for file in files), json)


def _autopilot(
    file: Path, known: mb.Calibration, ardupilot: Path | None, px4: Path | None, number: int
) -> dict[Path, str]:
    """Return path -> text of the requested autopilot files; report on stderr what they cannot hold."""
    from magbridge.calibration import export_compass

    if ardupilot is None and px4 is None:
        return {}
    compass, texts = export_compass.compass_of(known), dict[Path, str]()
    cli.complain_all(f"{file}: the autopilot's model cannot hold {lost}" for lost in compass.lost)
    if ardupilot is not None:
        texts[ardupilot], warnings = export_compass.ardupilot(compass, number)
        cli.complain_all(warnings)
    if px4 is not None:
        texts[px4] = export_compass.px4(compass, number)
    return texts


def _in_c(known: mb.Calibration, folder: Path) -> dict[Path, str]:
    """Return path -> text of the C files of a calibration and of its first scalar magnetometer."""
    from magbridge.calibration.export_c import c_header, c_source
    from magbridge.calibration.export_scalar import scalar_header, scalar_source

    vector, scalar = (folder / f"magbridge_{kind}.h" for kind in ("calibration", "scalar"))
    texts = {vector: c_header(known), vector.with_suffix(".c"): c_source(known)}
    for sensor in known.sensors[:1]:
        texts |= {scalar: scalar_header(sensor), scalar.with_suffix(".c"): scalar_source(sensor)}
    return texts


def _seaglider(file: Path, known: mb.Calibration, nt_per_count: float, dip: float) -> str:
    """Return a Seaglider's coefficients; report on stderr the omitted effects and their heading error."""
    from magbridge.calibration.export_compass import heading_cost, seaglider

    text = seaglider(known, nt_per_count)
    for cost in heading_cost(known, dip):
        names = ", ".join(one.name for one in known.parameters)
        what = f"{cost.name} alone" if cost.name else f"the field of {names}"
        cli.complain(
            f"{file}: the file cannot hold {what}: heading error {cost.rms:.2f} deg RMS, up to "
            f"{cost.largest:.2f} deg, at the ends of the range (dip {dip:g} deg)"
        )
    lost = [f"the effect {effect.kind} of {' '.join(effect.channels())}" for effect in known.effects]
    cli.complain_all(f"{file}: the file cannot hold {one}" for one in (*lost, "uncertainties and flags"))
    return text
