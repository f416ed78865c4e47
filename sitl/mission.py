"""What a deployment consists of: calibration spirals, a criss-cross survey, or a planner's list of legs."""

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
"""The paper's Table 1: run, pitch (deg), battery position (in) in trial 1 and in trial 2.

The ballast stands at -200 cm³ in a dive and at 200 cm³ in a climb.
"""


class Limit(Table, frozen=True):
    """``[limits.NAME]``: what the vehicle allows a moving mass: its ends (units) and speed (units/s)."""

    low: float
    high: float
    rate: Positive
    unit: str = ""


LIMITS = {name: Limit(low=m.low, high=m.high, rate=m.rate, unit=m.unit) for name, m in MOUNTINGS.items()}


class Leg(Table, frozen=True):
    """One descent, ascent or level stretch with every commanded value held."""

    duration: Positive
    """s."""
    pitch: Annotated[float, Meta(ge=-80, le=80)]
    roll: Annotated[float, Meta(ge=-80, le=80)] = 0.0
    """`pitch`, `roll`: deg."""
    turn: float = 0.0
    """Turn rate, deg/s, clockwise seen from above."""
    heading: float | None = None
    """deg at its start; None keeps the heading at which the last leg ended."""
    parameters: dict[str, float] = msgspec.field(default_factory=dict)
    """Positions of the moving masses; one that is not named stays where it is."""
    segment: str = "mission"
    """Consecutive legs of one name are one segment of the deployment."""


class Run(Table, frozen=True):
    """One calibration run, as a planner asks for it: deg, and positions of the moving masses.

    Without a `roll` the spiral banks as the vehicle's spirals do.
    """

    pitch: Annotated[float, Meta(ge=-80, le=80)]
    roll: Annotated[float, Meta(ge=-80, le=80)] | None = None
    parameters: dict[str, float] = msgspec.field(default_factory=dict)


class Spirals(Table, frozen=True, tag_field="kind", tag="spirals"):
    """Calibration runs: spirals, clockwise, each a descent or an ascent with every mass at rest."""

    trial: Literal[1, 2] = 1
    """1 or 2, which of the columns of :data:`TABLE_1` is flown."""
    runs: tuple[Run, ...] = ()
    """Flown instead of the table."""
    duration: Positive = 900.0
    """s of one descent or ascent; the paper's pair took about 30 minutes."""
    turns: float = 4.0
    """Full turns in a descent or ascent."""
    roll: tuple[float, NotNegative] = (6.0, 1.0)
    """Mean and spread of the bank, deg."""
    segment: str = "calibration"

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:
        """Return a leg for each run; masses that a run does not name are drawn for each."""
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
    """The survey: straight dives and climbs, zigzagging out along an axis and back again."""

    hours: Positive = 6.0
    """Its length."""
    pitch: tuple[float, NotNegative] = (26.0, 1.0)
    roll: tuple[float, NotNegative] = (0.0, 2.0)
    """`pitch`, `roll`: deg, mean and spread from leg to leg; the pitch changes sign between dives and climbs.
    """
    axis: float = 150.0
    zigzag: float = 45.0
    """`axis`, `zigzag`: deg, the way out, and how far legs run to either side of it."""
    yos_per_leg: Annotated[int, Meta(ge=1)] = 3
    """Dives and climbs between two changes of heading."""
    duration: Positive = 900.0
    """s of one descent or ascent."""
    battery_spread: NotNegative = 0.02
    """Spread of the battery's position about Table 1's at this pitch, in."""
    segment: str = "survey"

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:
        """Return dives and climbs in turn, as many as fit the hours."""
        count = 2 * max(1, round(self.hours * 1800 / self.duration))
        made = []
        for k in range(count):
            yo = k // 2
            back = 180.0 if 2 * yo >= count // 2 else 0.0
            side = 1.0 if (yo // self.yos_per_leg) % 2 else -1.0
            pitch = float(np.copysign(rng.normal(*self.pitch), k % 2 - 0.5))
            low, high = limits["battpos"].low, limits["battpos"].high
            battery = _battery(pitch) + rng.normal(0, self.battery_spread)
            made.append(
                Leg(
                    duration=self.duration,
                    pitch=pitch,
                    roll=float(rng.normal(*self.roll)),
                    heading=(self.axis + back + side * self.zigzag) % 360,
                    parameters=other_channels(rng, limits)
                    | {
                        "battpos": float(np.clip(battery, low, high)),
                        "ballast": float(np.copysign(200, pitch)),
                    },
                    segment=self.segment,
                )
            )
        return made


class Legs(Table, frozen=True, tag_field="kind", tag="legs"):
    """Legs as they are listed: what a planner asked for."""

    runs: tuple[Leg, ...]

    def legs(self, rng: np.random.Generator, limits: Mapping[str, Limit]) -> list[Leg]:  # noqa: ARG002  the others draw
        """Return the list."""
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
    """Return where the battery stands at `pitch`: both trials' mean, linear between the table's pitches."""
    rows = sorted((p, (a + b) / 2) for _, p, a, b in TABLE_1)
    pitches, places = zip(*rows, strict=True)
    return float(np.interp(pitch, pitches, places))
