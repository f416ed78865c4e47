"""Read a scenario: a TOML file that describes world, vehicle, instrument and mission."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from magbridge.config import NotNegative
from magbridge.errors import ConfigError
from magbridge.toml import Table, check_entries, convert, load_toml
from magbridge.wording import one_of
from sitl.instrument import Instrument
from sitl.mission import LIMITS, Limit, Part
from sitl.platform import MOUNTINGS, Mass, Vehicle
from sitl.trajectory import Motion
from sitl.world import Geology, Water

__all__ = ["SCENARIOS", "Hidden", "Place", "Scenario", "Telemetry", "load"]

SCENARIOS = Path(__file__).parent / "scenarios"
"""Folder of the scenarios that come with the package."""


class Place(Table, frozen=True):
    """Table ``[world]``: first position (deg), geology and water.

    If a log drives the scenario, the position is the log's.
    """

    latitude: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    longitude: Annotated[float, Meta(ge=-180, le=360)] = 0.0
    geology: Geology = Geology(sources=0)
    water: Water = Water()


class Telemetry(Table, frozen=True):
    """Table ``[telemetry]``: errors of the logged attitude and position, and the reference field."""

    roll_pitch_sigma: NotNegative = 0.1
    heading_sigma: NotNegative = 1.0
    """`roll_pitch_sigma`, `heading_sigma`: Standard deviations of white noise, deg."""
    drift: NotNegative = 0.0
    """Standard deviation on each axis of a constant drift velocity of the logged position, m/s."""
    reference: Literal["none", "true", "map"] = "none"
    """Content of ``reference_field``: ``none`` omits the column, ``true`` gives the true total field, ``map``
    gives the IGRF plus the anomaly of a simulated aeromagnetic map."""
    map_altitude: NotNegative = 90.0
    """Altitude of the aeromagnetic survey, m."""


class Hidden(Table, frozen=True):
    """Table ``[[hidden]]``: an effect that the calibration does not model."""

    effect: str
    """Name of the effect, a key of :data:`sitl.inject.EFFECTS`."""
    size: NotNegative
    """Size in the unit that the effect's function states."""
    segment: str = "survey"
    """Segment of the mission that has the effect."""


class Scenario(Table, frozen=True):
    """Contents of a scenario file."""

    name: str
    start: Annotated[datetime, Meta(tz=True)] = datetime(2013, 12, 11, 12, tzinfo=UTC)
    """Start time with its offset from UTC (TOML: ``2013-12-11T12:00:00Z``)."""
    masses: tuple[str, ...] = ("battpos", "ballast")
    """Moving masses (keys of :data:`sitl.platform.MOUNTINGS`) of a random vehicle."""
    vehicle: Vehicle | None = None
    """Vehicle of given magnetism; None for a random vehicle."""
    calibration: str | None = None
    """Path of a ``cal.json`` (relative to the scenario's file) that takes the place of a vehicle."""
    limits: dict[str, Limit] = msgspec.field(default_factory=dict)
    """Limits of masses that differ from :data:`sitl.mission.LIMITS`."""
    world: Place = Place()
    motion: Motion = Motion()
    instrument: Instrument = Instrument()
    telemetry: Telemetry = Telemetry()
    """`world`, `motion`, `instrument`, `telemetry`: Contents of the tables of these names."""
    hidden: tuple[Hidden, ...] = ()
    """Hidden effects to add to the deployment."""
    mission: tuple[Part, ...] = ()
    """Spirals, surveys and legs in their order; empty if a log drives the scenario."""

    @property
    def all_limits(self) -> dict[str, Limit]:
        """Limits of the vehicle's masses by name, always including battery and ballast."""
        names = dict.fromkeys(("battpos", "ballast", *self.masses))
        return {name: LIMITS[name] for name in names} | self.limits

    def replace(self, **changes: Any) -> Scenario:
        """Return a copy with changed values; a dict changes only the named entries of a table."""
        for name, change in changes.items():
            table = getattr(self, name)
            if isinstance(table, Table) and isinstance(change, dict):
                changes[name] = msgspec.structs.replace(table, **change)
        return msgspec.structs.replace(self, **changes)


def load(path: str | Path) -> Scenario:
    """Read and check a scenario file; a name without suffix means a scenario of the package.

    Raises
    ------
    ConfigError
        The file is missing or not TOML, a key is unknown or missing, or a value is impossible.
    """
    path = Path(path)
    if path.suffix == "":
        known = {one.stem: one for one in sorted(SCENARIOS.glob("*.toml"))}
        if str(path) not in known:
            raise ConfigError(path, "scenario", f"{one_of(str(path), known)}; or a file (.toml)")
        path = known[str(path)]
    table = load_toml(path)
    vehicle = table.get("vehicle")
    check_entries(vehicle if isinstance(vehicle, dict) else {}, "mass", Mass, path, "vehicle.")
    check_entries(table, "limits", Limit, path)
    scenario = convert(table, Scenario, path)
    for name in scenario.masses:
        if name not in MOUNTINGS:
            raise ConfigError(path, "masses", one_of(name, MOUNTINGS))
    if scenario.hidden:
        from sitl.inject import EFFECTS  # noqa: PLC0415 - the effects simulate scenarios

        for effect in (one.effect for one in scenario.hidden if one.effect not in EFFECTS):
            raise ConfigError(path, "hidden.effect", one_of(effect, EFFECTS))
    if scenario.calibration is None:
        return scenario
    calibration = path.parent / scenario.calibration
    if not calibration.is_file():
        raise ConfigError(path, "calibration", f"no such file: {calibration}")
    return scenario.replace(calibration=str(calibration))
