"""How far a bridge and an autopilot that takes its fixes lead each other astray, over hours.

    nice python tools/closed_loop.py [--runs 1] [--hours 6] [--maps 2] [--telemetry speed ...] [--workers 1]

Gliders of tools/navigation.py's study, on its maps: GPS for ten minutes, then none, and for the last five
again. Each is sailed twice for every kind of fix and every kind of telemetry that an autopilot may send: with
one that ignores fixes, and with one that takes them by the rules of ArduPilot or PX4 (``tools/referee``).

follows       what the bridge's dead reckoning followed while GPS was lost
obeying m     root mean square error of the bridge's position without GPS, with the autopilot that takes fixes
ignoring m    with the one that does not
ratio         the former over the latter
autopilot m   error of the autopilot's own position
alone m       that of the one that ignores fixes
claims m      its claim (1-sigma, an axis), root mean square
standardised  its error an axis over its claimed sigma, root mean square: 1 is consistent
back s        from the return of GPS until the autopilot is within 3 sigma of it
taken         of the sent fixes
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from navigation_studies.simulated import GLIDER, HOUR, SPEEDS, Map, synthetic, track_over
from referee import ArduPilot, Autopilot, Px4
from referee.loop import Passage, Run, sail
from studies import command_line

LOST, BACK = 600.0, 300.0
"""s: GPS is lost after the first, and back the second before the end."""
FOLLOWS = "dead reckoning by "
MAPS = (Map(20, 1000), Map(60, 2000))
STREAMS = {
    "speed": ("VFR_HUD",),
    "speed, local": ("VFR_HUD", "LOCAL_POSITION_NED"),
    "local": ("LOCAL_POSITION_NED",),
    "odometry": ("ODOMETRY",),
    "global": ("GLOBAL_POSITION_INT",),
    "all": ("VFR_HUD", "LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT"),
}
PAIRS: tuple[tuple[str, type[Autopilot]], ...] = (
    ("EXTERNAL_POSITION_ESTIMATE", ArduPilot),
    ("ODOMETRY", ArduPilot),
    ("EXTERNAL_POSITION_ESTIMATE", Px4),
    ("GLOBAL_POSITION_SENSOR", Px4),
)
HEADER = (
    "fix", "autopilot", "telemetry", "map", "follows", "obeying m", "ignoring m", "ratio", "autopilot m",
    "alone m", "claims m", "standardised", "back s", "taken",
)  # fmt: skip


class Case(NamedTuple):
    """One pair of runs."""

    fix: str
    stack: type[Autopilot]
    streams: str
    kind: Map
    seed: int
    hours: float


def passage(case: Case) -> Passage:
    """Return a track of the navigation study."""
    grid = synthetic(case.kind, case.seed % 10)
    ds = track_over(grid, GLIDER, 1000 + case.seed, hours=case.hours, speed=SPEEDS[case.seed % 3])
    last = case.hours * HOUR
    return Passage(
        ds["time"].to_numpy(),
        ds["truth_latitude"].to_numpy(),
        ds["truth_longitude"].to_numpy(),
        np.column_stack([ds["velocity_north"], ds["velocity_east"]]),
        ds["total_field"].to_numpy(),
        ds["total_field_sigma"].to_numpy(),
        30.0,
        lambda s: s < LOST or s > last - BACK,
    )


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def one(case: Case) -> list[str]:
    """Return one line of the table."""
    grid, way = synthetic(case.kind, case.seed % 10), passage(case)
    options = replace(GLIDER, start_sigma=0.2 * grid.correlation_length)

    def run(obeys: bool) -> tuple[Run, Autopilot]:
        make = partial(case.stack, streams=STREAMS[case.streams], obeys=obeys)
        return sail(way, grid, options, case.fix, make)[:2]

    with_us, autopilot = run(True)
    without, _ = run(False)
    lost = (with_us.seconds > LOST) & (with_us.seconds < case.hours * HOUR - BACK)
    fed = lost & (with_us.sent > 0)
    fed &= np.cumsum(fed) > LOST  # once it has converged
    if not fed.any():  # none was sent
        fed = lost
    obeying, ignoring = rms(with_us.error[lost]), rms(without.error[lost])
    reported = [
        text for second, text in with_us.texts if FOLLOWS in text and second < case.hours * HOUR - BACK
    ]
    back = with_us.seconds > case.hours * HOUR - BACK
    far = np.flatnonzero(np.hypot(*with_us.autopilot[back].T) > 3.0 * 2.5)
    return [
        case.fix, case.stack.__name__, case.streams, str(case.kind),
        reported[-1].removeprefix(FOLLOWS).partition(":")[0],
        f"{obeying:.1f}", f"{ignoring:.1f}", f"{obeying / ignoring:.2f}",
        f"{rms(np.hypot(*with_us.autopilot[fed].T)):.1f}", f"{rms(np.hypot(*without.autopilot[fed].T)):.1f}",
        f"{rms(with_us.claimed[fed]):.1f}", f"{rms(with_us.autopilot[fed] / with_us.claimed[fed, None]):.2f}",
        f"{far[-1] + 1 if far.size else 0}",
        ", ".join(f"{name} {number}" for name, number in autopilot.taken.most_common(3)),
    ]  # fmt: skip


def cases(runs: int, hours: float, maps: int, telemetry: Collection[str]) -> Iterator[Case]:
    """Yield all pairs of runs."""
    for (fix, stack), streams, kind, seed in product(PAIRS, telemetry, MAPS[:maps], range(runs)):
        yield Case(fix, stack, streams, kind, seed, hours)


def main() -> None:
    """Print the table."""
    parser = command_line(__doc__)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--hours", type=float, default=6.0)
    parser.add_argument("--maps", type=int, default=len(MAPS))
    parser.add_argument("--telemetry", nargs="+", choices=STREAMS, default=STREAMS)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    with ProcessPoolExecutor(arguments.workers) as pool:
        for line in pool.map(
            one, cases(arguments.runs, arguments.hours, arguments.maps, arguments.telemetry)
        ):
            print(f"| {' | '.join(line)} |", flush=True)


if __name__ == "__main__":
    main()
