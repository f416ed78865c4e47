"""Define the parts of a mission: calibration spirals, a criss-cross survey, or a list of legs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from magbridge.config import NotNegative, Positive
from magbridge.toml import Table
from sitl.platform import MOUNTINGS

__all__ = ["LIMITS", "TABLE_1", "CrissCross", "Leg", "Legs", "Limit", "Part", "Run", "Spirals"]

TABLE_1: tuple[tuple[int, float, float, float], ...] = (
    (1, -14.0, 0.272, 0.226),
    (2, 14.0, -0.181, -0.139),
    (3, -18.0, 0.380, 0.274),
    (4, 18.0, -0.234, -0.191),
    (5, -22.0, 0.428, 0.375),
    (6, 22.0, -0.289, -0.246),
    (7, -26.0, 0.491, 0.400),
    (8, 26.0, -0.344, -0.300),
    (9, -30.0, 0.527, 0.472),
    (10, 30.0, -0.401, -0.348),
)
"""Table 1 of the paper: run, pitch (deg), battery position (in) in trial 1 and in trial 2.

The ballast is at -200 cm³ in a dive and at 200 cm³ in a climb.
"""


class Limit(Table, frozen=True):
    """Table ``[limits.NAME]``: lowest and highest position (units) and speed (units/s) of a moving mass."""

    low: float
    high: float
    rate: Positive
    unit: str = ""


LIMITS = {name: Limit(low=m.low, high=m.high, rate=m.rate, unit=m.unit) for name, m in MOUNTINGS.items()}


class Leg(Table, frozen=True):
    """Descent, ascent or level stretch with constant commands."""

    duration: Positive
    """Duration of the leg, s."""
    pitch: Annotated[float, Meta(ge=-80, le=80)]
    roll: Annotated[float, Meta(ge=-80, le=80)] = 0.0
    """`pitch`, `roll`: Commanded angles, deg."""
    turn: float = 0.0
    """Turn rate, deg/s, clockwise seen from above."""
    heading: float | None = None
    """Heading at the start of the leg, deg; None keeps the heading at which the last leg ended."""
    parameters: dict[str, float] = msgspec.field(default_factory=dict)
    """Commanded positions of the moving masses; a mass that is not named does not move."""
    segment: str = "mission"
    """Name of the segment; consecutive legs of one name are one segment of the deployment."""


class Run(Table, frozen=True):
    """Calibration run of a planner: pitch and roll (deg), and positions of the moving masses.

    If `roll` is None, the roll is drawn from :attr:`Spirals.roll`.
    """

    pitch: Annotated[float, Meta(ge=-80, le=80)]
    roll: Annotated[float, Meta(ge=-80, le=80)] | None = None
    parameters: dict[str, float] = msgspec.field(default_factory=dict)


class Spirals(Table, frozen=True, tag_field="kind", tag="spirals"):
    """Calibration runs: clockwise spirals, each a descent or an ascent with all masses at rest."""

    trial: Literal[1, 2] = 1
    """Trial (1 or 2) whose column of :data:`TABLE_1` gives the battery positions."""
    runs: tuple[Run, ...] = ()
    """Runs to use in place of :data:`TABLE_1`."""
    duration: Positive = 900.0
    """Duration of one descent or ascent, s; the paper's pair took about 30 minutes."""
    turns: float = 4.0
    """Number of full turns in a descent or ascent."""
    roll: tuple[float, NotNegative] = (6.0, 1.0)
    """Mean and standard deviation of the roll, deg."""
    segment: str = "calibration"

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:
        """Return a leg for each run; draw unnamed positions of masses other than battery and ballast."""
        legs = []
        for run in self.runs or _table_1(self.trial):
            bank = float(rng.normal(*self.roll))
            leg = Leg(
                duration=self.duration,
                pitch=run.pitch,
                roll=bank if run.roll is None else run.roll,
                turn=360 * self.turns / self.duration,
                parameters=other_channels(rng, limits) | run.parameters,
                segment=self.segment,
            )
            legs.append(leg)
        return legs


class CrissCross(Table, frozen=True, tag_field="kind", tag="criss_cross"):
    """Survey of straight dives and climbs that zigzag out along an axis and back."""

    hours: Positive = 6.0
    """Duration of the survey, h."""
    pitch: tuple[float, NotNegative] = (26.0, 1.0)
    roll: tuple[float, NotNegative] = (0.0, 2.0)
    """`pitch`, `roll`: Mean and standard deviation over the legs, deg; the pitch changes sign between dives
    and climbs."""
    axis: float = 150.0
    zigzag: float = 45.0
    """`axis`, `zigzag`: Heading of the way out, and deviation of the legs to either side, deg."""
    yos_per_leg: Annotated[int, Meta(ge=1)] = 3
    """Number of pairs of dive and climb between two changes of heading."""
    duration: Positive = 900.0
    """Duration of one descent or ascent, s."""
    battery_spread: NotNegative = 0.02
    """Standard deviation of the battery's position about its position in Table 1 at the same pitch, in."""
    segment: str = "survey"

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:
        """Return alternate dives and climbs, as many as fit into the hours."""
        count = 2 * max(1, round(self.hours * 1800 / self.duration))
        made = []
        for k in range(count):
            yo = k // 2
            back = 180.0 if 2 * yo >= count // 2 else 0.0
            side = 1.0 if (yo // self.yos_per_leg) % 2 else -1.0
            pitch = float(np.copysign(rng.normal(*self.pitch), k % 2 - 0.5))
            low, high = limits["battpos"].low, limits["battpos"].high
            battery = np.clip(_battery(pitch) + rng.normal(0, self.battery_spread), low, high)
            known = {"battpos": float(battery), "ballast": float(np.copysign(200, pitch))}
            leg = Leg(
                duration=self.duration,
                pitch=pitch,
                roll=float(rng.normal(*self.roll)),
                heading=(self.axis + back + side * self.zigzag) % 360,
                parameters=other_channels(rng, limits) | known,
                segment=self.segment,
            )
            made.append(leg)
        return made


class Legs(Table, frozen=True, tag_field="kind", tag="legs"):
    """Explicit list of legs, for example from a planner."""

    runs: tuple[Leg, ...]

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:  # noqa: ARG002  the others draw
        """Return the listed legs; nothing is drawn."""
        return [*self.runs]


Part = Spirals | CrissCross | Legs


def _table_1(trial: int) -> tuple[Run, ...]:
    return tuple(
        Run(
            pitch=pitch, parameters={"battpos": battery[trial - 1], "ballast": float(np.copysign(200, pitch))}
        )
        for _, pitch, *battery in TABLE_1
    )


def other_channels(rng: np.random.Generator, limits: Mapping[str, Limit]) -> dict[str, float]:
    """Draw a position for every mass that is not in Table 1, within the inner nine tenths of its travel."""
    return {
        name: float(rng.uniform(0.95 * limit.low + 0.05 * limit.high, 0.05 * limit.low + 0.95 * limit.high))
        for name, limit in limits.items()
        if name not in ("battpos", "ballast")
    }


def _battery(pitch: float) -> float:
    """Return the battery's position (in) at `pitch` (deg): Table 1's mean over both trials, interpolated."""
    rows = sorted((p, (a + b) / 2) for _, p, a, b in TABLE_1)
    pitches, places = zip(*rows, strict=True)
    return float(np.interp(pitch, pitches, places))
