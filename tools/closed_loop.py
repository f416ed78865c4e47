"""Measure how far the positions of a bridge and of an autopilot that uses its fixes diverge over hours.

    python tools/closed_loop.py [--seeds 1] [--hours 6] [--charts 2] [--telemetry speed ...]

The gliders of tools/navigation.py have GPS for the first ten and the last five minutes only.
Each kind of fix and of telemetry is run twice: with an autopilot that ignores fixes, and with an autopilot
that uses fixes by the rules of ArduPilot or PX4 (``tools/referee``).

bridge, m     RMS error of the bridge's position without GPS, with the autopilot that uses fixes
ratio         this error over the bridge's error with the autopilot that ignores fixes
autopilot     RMS error of the autopilot's position; *alone*: the same of the autopilot that ignores fixes
claimed       RMS of the autopilot's 1-sigma on an axis; *normalised*: its error on an axis over this 1-sigma
back, s       time from the return of GPS until the autopilot's position is within 3 sigma of GPS
"""

from __future__ import annotations

from functools import partial

import numpy as np
from msgspec.structs import replace
from referee import ArduPilot, Autopilot, Px4
from referee.loop import outage, sail
from studies import Column, Row, Study
from voyages import GLIDER, HOUR, SPEEDS, Map, synthetic, track_over

LOST_S, BACK_S = 600.0, 300.0
"""Durations of GPS reception at the start and at the end of a run, s."""
MAPS = (Map(20, 1000), Map(60, 2000))
STREAMS = {
    "speed": ("VFR_HUD",),
    "speed, local": ("VFR_HUD", "LOCAL_POSITION_NED"),
    "local": ("LOCAL_POSITION_NED",),
    "odometry": ("ODOMETRY",),
    "global": ("GLOBAL_POSITION_INT",),
    "all": ("VFR_HUD", "LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT"),
}
AUTOPILOTS: dict[str, type[Autopilot]] = {"ArduPilot": ArduPilot, "PX4": Px4}
PAIRS = (
    "EXTERNAL_POSITION_ESTIMATE ArduPilot",
    "ODOMETRY ArduPilot",
    "EXTERNAL_POSITION_ESTIMATE PX4",
    "GLOBAL_POSITION_SENSOR PX4",
)
"""Fixes and the autopilots that get them."""


def rms(values: np.ndarray) -> float:
    """Return the root mean square of the values that are not NaN."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def run(pair: str, telemetry: str, chart: int, seed: int, hours: float) -> list[Row]:
    """Simulate a glider with an autopilot that uses fixes and with one that ignores fixes; return the row."""
    fix, autopilot = pair.split()
    kind = MAPS[chart]
    grid, end = synthetic(kind, seed % 10), hours * HOUR - BACK_S
    flown = track_over(grid, GLIDER, 1000 + seed, hours=hours, speed=SPEEDS[seed % 3])
    options = replace(GLIDER, start_sigma=0.2 * grid.correlation_length)

    make = partial(AUTOPILOTS[autopilot], streams=STREAMS[telemetry])
    using, ignoring = (
        sail(flown, outage(LOST_S, end + 1.0), grid, options, fix, partial(make, obeys=obeys))[0]
        for obeys in (True, False)
    )
    lost = (using.seconds > LOST_S) & (using.seconds < end)
    fed = lost & (using.sent > 0)
    fed &= np.cumsum(fed) > LOST_S  # after it has converged
    fed = fed if fed.any() else lost
    far = np.flatnonzero(np.hypot(*using.autopilot[using.seconds > end].T) > 3.0 * 2.5)
    bridge = rms(using.error[lost])
    return [
        {
            "map": str(kind),
            "bridge": bridge, "ratio": bridge / rms(ignoring.error[lost]),
            "own": rms(np.hypot(*using.autopilot[fed].T)), "alone": rms(np.hypot(*ignoring.autopilot[fed].T)),
            "claimed": rms(using.claimed[fed]),
            "normalised": rms(using.autopilot[fed] / using.claimed[fed, None]),
            "back": float(far[-1] + 1 if far.size else 0),
        }
    ]  # fmt: skip


STUDY = Study(
    run,
    ("pair", "telemetry", "map"),
    {
        "bridge, m": Column("bridge", form=".0f"),
        "ratio": Column("ratio"),
        "autopilot": Column("own", form=".0f"),
        "alone": Column("alone", form=".0f"),
        "claimed": Column("claimed", form=".0f"),
        "normalised": Column("normalised"),
        "back, s": Column("back", np.max, ".0f"),
    },
)


if __name__ == "__main__":
    STUDY.main(__doc__, pairs=list(PAIRS), telemetry=list(STREAMS), charts=len(MAPS), seeds=1, hours=6.0)
