"""Correct a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magbridge.cli.common import (
    AS_THEY_SAY,
    Json,
    Log,
    Plot,
    ReadingOptions,
    SavedCalibration,
    command,
    complain,
    logs_to_read,
    print_result,
)
from magbridge.cli.remarks import (
    note_losses,
    note_missing,
    note_no_date,
    note_settings,
    refuse_unsuited,
    warnings_of,
)
from magbridge.columns import CHANNELS, CORRECTED
from magbridge.errors import ConfigError, DataError, WrongUse
from magbridge.progress import track
from magbridge.records import Quality
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.model import Calibration
    from magbridge.config import Config
    from magbridge.correction import Correction
    from magbridge.learning import Learner

COPIED_COLUMNS = (
    *("latitude", "longitude", "depth", "roll", "pitch", "heading", "run", "dive", "line", "line_type"),
    *("sensor_temperature", "reference_field", "velocity_north", "velocity_east", "water_speed"),
    *("local_north", "local_east", "dr_latitude", "dr_longitude", "gps_latitude", "gps_longitude"),
    *("truth_latitude", "truth_longitude"),
)
"""Columns of a log that are copied to the output, with the calibration's parameters."""


@command("correct FILE... --calibration cal.json -o FILE [OPTIONS]")
def correct(
    *files: Path,
    calibration: Path | None = None,
    output: Log,
    learn: bool = False,
    config: Path | None = None,
    save: SavedCalibration = None,
    plot: Plot = None,
    reading: ReadingOptions = AS_THEY_SAY,
    json: Json = False,
) -> None:
    """Correct a log with a calibration, as the bridge would have done live.

    The arithmetic and the state (lags, backlash) are the bridge's own, but the input is the log's rows. In a
    bridge's own log (also converted to .nc or .parquet) these are MAG_RAW with the latest telemetry before
    each and its age; [align] and every max_age are known as they were when the log began, not as they were
    set later. The bridge itself uses every message about a moving mass, and the channels of a sensor that has
    no counts are float32 here (to 0.002 nT of 50,000 nT). In another log, telemetry counts as new in every
    row that has it, and rows that have nothing else are not samples: they are left out of the output. To
    compute the bridge's output bit for bit, put the calibration into a bridge.toml and run:
    magbridge replay LOG --config bridge.toml --log DIR. The replay also reports that this differs from the
    output published at the time.

    Parameters
    ----------
    files
        The logs of one deployment.
    calibration
        The calibration (cal.json); with --config by default that of the bridge.
    output
        The file to write: total field with its sigma, vector, anomaly and quality flags; also the log's
        position, depth, attitude and the calibration's parameters. With a scalar magnetometer in the
        calibration and in the log: scalar_field, its sigma and flags.
    learn
        Learn the calibration during the run, as a bridge with [learning] does; the log needs positions.
    config
        With --learn: the bridge.toml whose [learning] and calibration count. It may have no calibration:
        learning then starts without one.
    save
        With --learn: where to write the calibration that was published last.
    plot
        A PNG, PDF or SVG to draw: the corrected field with its 2-sigma band, and the flagged samples.
    """
    source = _source(calibration, config, learn=learn)
    logs_to_read(files, output, source, reading.columns)

    from magbridge.logs import Writer, read_chunks

    known, settings = _known(calibration, config)
    for doubt in warnings_of(known, source):
        complain(doubt)
    if save is not None and not learn:
        raise WrongUse("--save writes the learned calibration: give --learn, too")
    tally = Tally()
    correction: Correction | None = None
    pieces: list[dict[str, Any]] = []
    drawn: list[xr.Dataset] = []
    with Writer(output) as writer:
        parts = track(read_chunks(files, required=CHANNELS, options=reading.options), "correcting")
        given = files, known, source, settings if learn else None
        for part, corrected, correction in _scalar_too(_corrected(parts, *given), known):
            writer.append(corrected)
            _notify(correction)
            pieces.append(part.attrs)
            tally.add(corrected, part.sizes["time"])
            if plot:
                drawn.append(corrected[list(CORRECTED)])
    if plot:
        from magbridge.logs.deployment import join
        from magbridge.logs.draw import draw_corrected

        draw_corrected(join(drawn), plot)
    note_losses(*pieces)
    note_settings(*pieces)
    if doubt := tally.doubt():
        complain(f"{source}: {doubt}")
    facts, summary = tally.facts(), tally.summary()
    if correction is not None and correction.learner is not None:
        summary += _keep_learned(correction.learner, known, facts, save)
    print_result({"file": str(output), **facts}, f"{output}: {summary}", json)


def _scalar_too(
    pieces: Iterator[tuple[xr.Dataset, xr.Dataset, Correction]], known: Calibration
) -> Iterator[tuple[xr.Dataset, xr.Dataset, Correction]]:
    """Yield the corrected pieces, with the compensated scalar where the calibration has one.

    The swing of a channel is that of the whole log: with a scalar the pieces are one.
    """
    if not known.sensors:
        yield from pieces
        return
    from magbridge.calibration.fitting.scalar_log import with_scalar
    from magbridge.logs.deployment import join

    logs, corrected, correction = zip(*pieces, strict=True)
    log = join(logs)
    yield log, with_scalar(join(corrected), log, known.sensors), correction[-1]


def _source(calibration: Path | None, config: Path | None, *, learn: bool) -> Path:
    """Return the file that describes the vehicle: the calibration, or the configuration."""
    if config is not None and not learn:
        raise WrongUse("--config says how to learn: give --learn, too")
    source = calibration or config
    if source is None:
        raise WrongUse("expected --calibration cal.json, or --learn with --config bridge.toml")
    return source


def _known(file: Path | None, config: Path | None) -> tuple[Calibration, Config]:
    """Return the calibration to begin with, and a bridge's settings.

    ConfigError: the configuration has no calibration, and no ``[learning]`` that could do without.
    """
    from magbridge.bridge.learning import first_calibration
    from magbridge.calibration.file import load
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
    known = load(file) if file is not None else first_calibration(settings)
    assert known is not None
    return known, settings


def _corrected(
    parts: Iterable[xr.Dataset], files: tuple[Path, ...], known: Calibration, file: Path, learn: Config | None
) -> Iterator[tuple[xr.Dataset, xr.Dataset, Correction]]:
    """Yield each piece of a log, its corrected samples, and the correction; DataError: it has no field."""
    from magbridge.correction import Correction
    from magbridge.rows import correct_rows

    correction, whole = None, False
    for part in parts:
        if correction is None:
            note_missing(known, part)
            note_no_date(part)
            correction = Correction(known, learner=_learner(known, part, learn) if learn else None)
        if not whole:
            refuse_unsuited(known, part)
        sampled = part[list(CHANNELS)].to_array().notnull()
        corrected = _with_log_columns(part, correct_rows(correction, part), known, file)
        yield part, corrected.isel(time=sampled.any("variable").to_numpy()), correction
        whole = whole or bool(sampled.all("variable").any())
    if not whole:
        raise DataError(f"{', '.join(map(str, files))}: no row has all of {' '.join(CHANNELS)}")


def _learner(known: Calibration, log: xr.Dataset, settings: Config) -> Learner:
    """Return a learner with a bridge's settings, which knows of the currents in the log."""
    from magbridge.bridge.learning import open_learner

    currents = tuple(str(name) for name in log.data_vars if log[name].attrs.get("units") == "A")
    learner = open_learner(settings, known, None if settings.telemetry else currents)
    assert learner is not None
    return learner


def _notify(correction: Correction) -> None:
    """Print the quality flags and the notifications of learning."""
    for text in correction.notices:
        complain(text)
    correction.notices.clear()
    if correction.learner is not None:
        for notice in correction.learner.notices:
            complain(f"{notice.text}, {notice.date}")
        correction.learner.notices.clear()


def _keep_learned(learner: Learner, known: Calibration, facts: dict[str, Any], file: Path | None) -> str:
    """Write the last published calibration, add to the facts to print as JSON, and return a summary."""
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


def _with_log_columns(log: xr.Dataset, corrected: xr.Dataset, known: Calibration, file: Path) -> xr.Dataset:
    """Return the corrected columns with those of the log that say where and in what state they were taken."""
    from magbridge.calibration.file import calibration_id
    from magbridge.logs.deployment import HISTORY_ATTRIBUTE, MEANING, lasting

    names = [name for name in (*COPIED_COLUMNS, *known.channels) if name in log and name not in corrected]
    made = f"corrected with {file.name}, calibration {calibration_id(known):08x}"
    history = [*str(log.attrs.get(HISTORY_ATTRIBUTE, "")).splitlines(), made]
    attrs = {"calibration_id": f"{calibration_id(known):08x}", HISTORY_ATTRIBUTE: "\n".join(history)}
    meaning = {name: value for name, value in lasting(log.attrs).items() if name in MEANING}
    kept = {name: log[name] for name in names}
    if "heading" in corrected and "heading" in log:
        kept["vehicle_heading"] = log["heading"]
        meaning = {name: value for name, value in meaning.items() if name != "heading_reference"}
    return corrected.assign(kept).assign_attrs(meaning | attrs)


@dataclass
class Tally:
    """Statistics of a log so far."""

    samples: int = 0
    left_out: int = 0
    """`samples`, `left_out`: Rows corrected, and rows that are not samples."""
    flagged: int = 0
    """Samples whose total field is flagged."""
    flags: Counter[str] = field(default_factory=Counter)
    """Name of a flag -> samples that carry it."""
    unearthly: int = 0
    """Samples whose total field is none of the Earth's."""

    def add(self, corrected: xr.Dataset, rows: int) -> None:
        """Count the samples of a corrected piece of the log."""
        from magbridge.field.reference import MAIN_FIELD_RANGE_NT

        self.samples += corrected.sizes["time"]
        self.left_out += rows - corrected.sizes["time"]
        doubtful = ~Quality.NO_BORESIGHT  # without a boresight, the total field is just as good
        quality = corrected["quality"].to_numpy().astype(int)
        self.flagged += int((quality & doubtful != 0).sum())
        self.flags.update({flag.names(): int((quality & flag != 0).sum()) for flag in doubtful})
        total = corrected["total_field"]
        self.unearthly += int(((total < MAIN_FIELD_RANGE_NT[0]) | (total > MAIN_FIELD_RANGE_NT[1])).sum())

    def doubt(self) -> str:
        """Return why the calibration may be another vehicle's; empty without such an indication."""
        from magbridge.field.reference import MAIN_FIELD_RANGE_NT

        if self.unearthly <= self.samples / 2:
            return ""
        low, high = (f"{limit:,.0f}" for limit in MAIN_FIELD_RANGE_NT)
        return (
            f"{self.unearthly} of {self.samples} corrected total fields are outside the Earth's range, {low} "
            f"to {high} nT; use the calibration of this vehicle"
        )

    def facts(self) -> dict[str, Any]:
        """Return the numbers to print as JSON."""
        left_out = {"left_out": self.left_out}
        return {"rows": self.samples, "flagged": self.flagged, "flags": +self.flags, **left_out}

    def summary(self) -> str:
        """Return the numbers in a sentence."""
        named = ", ".join(f"{name} {count}" for name, count in (+self.flags).items())
        text = f"{counted(self.samples, 'sample')}, {self.flagged} of them flagged"
        text += f" ({named})" if named else ""
        if self.left_out:
            text += f"; {counted(self.left_out, 'row')} without any of {' '.join(CHANNELS)} left out"
        return text
