"""A scenario: one TOML file that describes world, vehicle, instrument and mission."""

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
"""The scenarios that come with the package."""


class Place(Table, frozen=True):
    """``[world]``: where, with the crustal field and the water.

    A scenario that is driven by a log takes the place from the log.
    """

    latitude: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    longitude: Annotated[float, Meta(ge=-180, le=360)] = 0.0
    geology: Geology = Geology(sources=0)
    water: Water = Water()


class Telemetry(Table, frozen=True):
    """``[telemetry]``: errors of the vehicle's own attitude and position, and the reference."""

    roll_pitch_sigma: NotNegative = 0.1
    heading_sigma: NotNegative = 1.0
    """`roll_pitch_sigma`, `heading_sigma`: deg, white."""
    drift: NotNegative = 0.0
    """m/s an axis, standard deviation of a steady current that the logged position lacks."""
    reference: Literal["none", "true", "map"] = "none"
    """What ``reference_field`` holds: ``none`` leaves it out, ``true`` is the true total field, ``map`` is
    the IGRF with the anomaly of the map that an aeromagnetic survey would have made."""
    map_altitude: NotNegative = 90.0
    """m of that survey."""


class Hidden(Table, frozen=True):
    """``[[hidden]]``: something happens that the calibration does not know."""

    effect: str
    """Of :data:`sitl.inject.EFFECTS`."""
    size: NotNegative
    """In the effect's own unit: see its function."""
    segment: str = "survey"
    """The part of the mission that it shows in."""


class Scenario(Table, frozen=True):
    """A whole scenario file."""

    name: str
    start: Annotated[datetime, Meta(tz=True)] = datetime(2013, 12, 11, 12, tzinfo=UTC)
    """With its offset from UTC (TOML: ``2013-12-11T12:00:00Z``)."""
    masses: tuple[str, ...] = ("battpos", "ballast")
    """Kinds of moving mass (keys of :data:`sitl.platform.MOUNTINGS`) of a vehicle that is drawn from the
    seed."""
    vehicle: Vehicle | None = None
    """A vehicle whose magnetism is given; nothing is drawn then."""
    calibration: str | None = None
    """A ``cal.json`` (relative to the scenario's file) that describes vehicle and instrument, in place of a
    vehicle."""
    limits: dict[str, Limit] = msgspec.field(default_factory=dict)
    """The vehicle's limits where they differ from those of its kind of mass."""
    world: Place = Place()
    motion: Motion = Motion()
    instrument: Instrument = Instrument()
    telemetry: Telemetry = Telemetry()
    """`world`, `motion`, `instrument`, `telemetry`: The tables of these names."""
    hidden: tuple[Hidden, ...] = ()
    """What happens besides."""
    mission: tuple[Part, ...] = ()
    """Spirals, surveys and legs, one after the other; empty where a log is to drive the scenario."""

    @property
    def all_limits(self) -> dict[str, Limit]:
        """Limits of every mass the vehicle has, battery and ballast always among them."""
        names = dict.fromkeys(("battpos", "ballast", *self.masses))
        return {name: LIMITS[name] for name in names} | self.limits

    def replace(self, **changes: Any) -> Scenario:
        """Return the scenario with other values; of a table, a dict of those that change."""
        for name, change in changes.items():
            table = getattr(self, name)
            if isinstance(table, Table) and isinstance(change, dict):
                changes[name] = msgspec.structs.replace(table, **change)
        return msgspec.structs.replace(self, **changes)


def load(path: str | Path) -> Scenario:
    """Read and check a scenario file; a bare name is one that comes with the package.

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
        _check_hidden(scenario.hidden, path)
    if scenario.calibration is None:
        return scenario
    calibration = path.parent / scenario.calibration
    if not calibration.is_file():
        raise ConfigError(path, "calibration", f"no such file: {calibration}")
    return scenario.replace(calibration=str(calibration))


def _check_hidden(hidden: tuple[Hidden, ...], path: Path) -> None:
    from sitl.inject import EFFECTS  # noqa: PLC0415 - the effects simulate scenarios

    for one in hidden:
        if one.effect not in EFFECTS:
            raise ConfigError(path, "hidden.effect", one_of(one.effect, EFFECTS))
