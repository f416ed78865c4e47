"""What commands say of logs and calibrations before they use them, and what they refuse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magbridge.cli.common import complain
from magbridge.errors import CalibrationError, DataError, FormatError, OutOfRange, WrongUse
from magbridge.wording import counted

if TYPE_CHECKING:
    import xarray as xr

    from magbridge.calibration.model import Calibration

__all__ = [
    "by_base_station", "chosen_parameters", "naming", "note_losses", "note_missing", "note_no_date",
    "note_settings", "note_unused_grid", "refuse_unsuited", "warnings_of",
]  # fmt: skip

MAX_NAMED_LOSSES = 5
"""Losses that are named, a line each; the others are counted."""


@contextmanager
def naming(deployment: xr.Dataset) -> Iterator[None]:
    """Name the logs in the error messages of what is done with them: raise these as :class:`DataError`."""
    try:
        yield
    except (CalibrationError, OutOfRange) as error:
        raise DataError(f"{deployment.attrs['source']}: {error}") from error


def warnings_of(calibration: Calibration, file: Path) -> list[str]:
    """Return a line that says why the data that a calibration was fitted to do not support it, or none."""
    warnings = "; ".join(calibration.warnings)
    return [f"{file}: the data it was fitted to do not support it: {warnings}"] if warnings else []


def note_losses(*pieces: Mapping[str, Any]) -> None:
    """Report on stderr what reading skipped, from the attributes of a deployment or of its pieces."""
    from magbridge.logs.deployment import COUNTERS, GUESSED_ATTRIBUTE, named_losses, noted, passed_over

    for guess in dict.fromkeys(str(attrs.get(GUESSED_ATTRIBUTE, "")) for attrs in pieces):
        if guess:
            complain(f"guessed: {guess}")
    if counts := passed_over(*pieces):
        losses = ", ".join(f"{count} {COUNTERS[name][count > 1]}" for name, count in counts.items())
        complain(f"in the logs: {losses}")
    for note in dict.fromkeys(noted(*pieces)):
        complain(note)
    lines = named_losses(*pieces)
    for line in lines[:MAX_NAMED_LOSSES]:
        complain(line)
    if len(lines) > MAX_NAMED_LOSSES:
        complain(f"and in {counted(len(lines) - MAX_NAMED_LOSSES, 'place')} more")


def by_base_station(logs: Sequence[xr.Dataset], base: Path | None) -> list[xr.Dataset]:
    """Return a vehicle's logs with what the field varied by.

    That is by a file of its own, or by an observatory's log among the others.

    FormatError, DataError: the base station's log has no field, or not for the logs' time.
    """
    from magbridge.field.base_station import separate_observatories, with_daily_variation
    from magbridge.logs import read
    from magbridge.logs.deployment import join

    own, stations = separate_observatories(logs)
    if base is not None:
        stations = [read(base)]
    if not own or not stations:
        return list(logs)
    if len({station.attrs.get("observatory") for station in stations}) > 1:
        names = " and ".join(str(station.attrs["source"]) for station in stations)
        raise WrongUse(f"{names} are of several observatories: give one of them, the nearest")
    station = join(stations)
    note_losses(station.attrs)
    return with_daily_variation(own, station)


def chosen_parameters(named: Sequence[str], deployment: xr.Dataset, **options: Any) -> tuple[str, ...]:
    """Return the parameters of a fit: those that are named, or for ``auto`` the columns that are worth it.

    ``auto`` tries positions, currents, temperatures and pressures.
    The improvement by each column on held-out parts is printed to stderr. `options` are of
    :func:`~magbridge.calibration.fitting.parameter_choice.best_parameters`.

    WrongUse: ``auto`` among names.
    """
    from magbridge.calibration.fitting.parameter_choice import AUTO, best_parameters, lines
    from magbridge.logs.info import conditions, movers

    if AUTO not in named:
        return tuple(named)
    if len(named) > 1:
        raise WrongUse(f"--parameter {AUTO}: chooses all parameters; name no other")
    offered = [*movers(deployment), *conditions(deployment)]
    taken, offers = best_parameters(deployment, offered, **options)
    for line in lines(offers) or [
        f"--parameter {AUTO}: none of {' '.join(offered) or 'its columns'} moves the field"
    ]:
        complain(line)
    return taken


def note_missing(calibration: Calibration, deployment: xr.Dataset) -> None:
    """Warn on stderr of columns that the calibration needs and a log does not have."""
    for name in calibration.channels:
        if name not in deployment:
            lacking = f"{deployment.attrs['source']}: no column {name!r}, which the calibration needs"
            remedy = f"name the log's own column with --column {name}=THEIRS"
            complain(f"{lacking}: every sample is flagged, with a wider sigma; {remedy}")


def note_unused_grid(grid: Path | None, *logs: xr.Dataset) -> None:
    """Warn on stderr of logs that hold a reference in every row: a grid is only added to the IGRF."""
    for log in logs if grid else ():
        if "reference_field" in log and log["reference_field"].notnull().all():
            complain(f"{log.attrs['source']}: has reference_field in every row: --grid {grid} is not used")


def note_no_date(deployment: xr.Dataset) -> None:
    """Warn on stderr that a log has no anomaly, since the field of its day is not known."""
    from magbridge.columns import counts_from_boot

    if counts_from_boot(deployment):
        source = deployment.attrs["source"]
        complain(f"{source}: its times count from the boot: no anomaly without --date YYYY-MM-DD")


def note_settings(*pieces: Mapping[str, Any]) -> None:
    """Warn on stderr where a bridge was tuned in the course of its log, from the attributes of its pieces."""
    from magbridge.logs.deployment import CHANGES_SETTING

    for attrs in pieces:
        if times := int(attrs.get(CHANGES_SETTING, 0)):
            often = "once" if times == 1 else f"{times} times"
            complain(
                f"{attrs['source']}: MB_* parameters were set {often} in the course of the log; it is "
                "corrected with those of its start (magbridge replay follows them)"
            )
            return


def refuse_unsuited(calibration: Calibration, deployment: xr.Dataset) -> None:
    """FormatError: a log to be corrected is of another sensor, or parameters or channels in another unit."""
    from magbridge.columns import CHANNELS, require_units
    from magbridge.field.reference import other_units

    source, sensor = deployment.attrs["source"], str(deployment.attrs.get("sensor", ""))
    if not calibration.sensor.may_be(sensor):
        raise FormatError(source, f"sensor {sensor!r}, but the calibration is of {calibration.sensor.name!r}")
    require_units(deployment, calibration.units)
    channels = deployment[list(CHANNELS)].to_array().to_numpy().T
    if wrong := other_units(channels, calibration.reference.field):
        raise FormatError(source, wrong)
