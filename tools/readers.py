"""Measure how fast logs are read, compared with the usual libraries.

    python tools/readers.py [--times 3] LOG...

Each reader runs in its own process, whose start and imports count; Slocum segments are read together. The
table has the processor time (all processes, least of several runs), its ratio, and the largest memory.
Third-party readers read the same content as far as their options allow: pymavlink and rosbags read
magbridge's messages, pyulog its topics, dbdreader its sensors, xarray all variables. Their processes do not
import magbridge, but get the names from this process.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

OURS = "magbridge"


def ours(paths: list[Path], wanted: Any) -> None:  # noqa: ARG001 - it knows what it reads
    """Read the logs as ``magbridge convert`` does."""
    from magbridge.logs import read_each  # noqa: PLC0415 - its imports are part of what is measured

    read_each(paths)


def by_xarray(paths: list[Path], wanted: Any) -> None:  # noqa: ARG001 - it has no such option
    """Load every variable of the files."""
    import xarray as xr  # noqa: PLC0415

    for path in paths:
        xr.open_dataset(path, decode_times=False).load()


def by_pymavlink(paths: list[Path], wanted: Any) -> None:
    """Read the kinds of messages that magbridge reads."""
    from pymavlink import mavutil  # noqa: PLC0415

    for path in paths:
        connection: Any = mavutil.mavlink_connection(str(path))
        while connection.recv_match(type=wanted) is not None:
            pass


def by_pyulog(paths: list[Path], wanted: Any) -> None:
    """Read the topics that magbridge reads."""
    from pyulog import ULog  # noqa: PLC0415

    for path in paths:
        ULog(str(path), wanted)


def by_rosbags(paths: list[Path], wanted: Any) -> None:
    """Read and decode the types of messages that magbridge reads."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415

    for path in paths:
        with AnyReader([path]) as bag:
            chosen = [one for one in bag.connections if one.msgtype.replace("/msg/", "/") in wanted]
            for connection, _, data in bag.messages(connections=chosen):
                bag.deserialize(data, connection.msgtype)


def by_dbdreader(paths: list[Path], wanted: Any) -> None:
    """Read the sensors that magbridge reads, from flight and science files."""
    import dbdreader  # noqa: PLC0415

    partners = [path.with_suffix(wanted[0][path.suffix]) for path in paths if path.suffix in wanted[0]]
    for path in [*paths, *partners]:
        file = dbdreader.DBD(str(path), cacheDir=str(path.parent))
        file.get(file.timeVariable, *(name for name in wanted[1] if name in file.parameterNames))


def wanted_by(name: str) -> Any:
    """Return the names that magbridge reads of a format, as the third-party reader expects them, or None."""
    from magbridge.logs import ardupilot, px4, rosbag, slocum, telemetry  # noqa: PLC0415

    return {
        "ardupilot": [*ardupilot.WANTED],
        "telemetry": [*telemetry.MAVLINK_FIELDS, "NAMED_VALUE_FLOAT"],
        "px4": [*px4.PX4_FIELDS, *px4.NEEDED_FIELDS],
        "ros": [*rosbag.MESSAGE_KINDS],
        "slocum": [slocum.SCIENCE, [*slocum.SENSORS]],
    }.get(name)


PEERS: dict[str, Callable[[list[Path], Any], None]] = {
    "netcdf": by_xarray,
    "ardupilot": by_pymavlink,
    "telemetry": by_pymavlink,
    "px4": by_pyulog,
    "ros": by_rosbags,
    "slocum": by_dbdreader,
}


def main() -> None:
    """Print a row for each log, and for all Slocum segments together."""
    if sys.argv[1:2] == ["--reader"]:  # a process that is timed
        _, _, reader, wanted, *logs = sys.argv
        ({OURS: ours} | PEERS)[reader]([*map(Path, logs)], json.loads(wanted))
        print(*_used())
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("logs", nargs="+", type=Path)
    chosen = parser.parse_args()
    from rich.console import Console  # noqa: PLC0415 - not in the processes that are timed
    from rich.table import Table  # noqa: PLC0415

    table = Table("log", "MB", "magbridge, s", "peer, s", "", "ratio", "memory, MB")
    for name, paths in _groups(chosen.logs):
        size = sum(
            one.stat().st_size for path in paths for one in ([*path.iterdir()] if path.is_dir() else [path])
        )
        mine, memory = _timed(OURS, paths, chosen.times)
        theirs, _ = _timed(name, paths, chosen.times)
        label = paths[0].name if len(paths) == 1 else f"{len(paths)} segments"
        table.add_row(label, f"{size / 1e6:.0f}", f"{mine:.2f}", f"{theirs:.2f}", PEERS[name].__name__[3:],
                      f"{mine / theirs:.2f}", f"{memory:.0f}")  # fmt: skip
    Console().print(table)


def _groups(logs: list[Path]) -> list[tuple[str, list[Path]]]:
    """Return format and paths of each reading task: one log each, but all Slocum segments together."""
    from magbridge.logs.registry import FORMATS, format_of  # noqa: PLC0415

    names = {id(form): name for name, form in FORMATS.items()}
    kinds = {path: names[id(format_of(path))] for path in logs}
    segments = [path for path, kind in kinds.items() if kind == "slocum"]
    single = [(kind, [path]) for path, kind in kinds.items() if kind != "slocum"]
    return [*single, *[("slocum", segments)] * bool(segments)]


def _timed(reader: str, paths: list[Path], times: int) -> tuple[float, float]:
    """Return the least processor time (s) and the largest memory (MB) of several runs of a reader."""
    wanted = "null" if reader == OURS else json.dumps(wanted_by(reader))
    command = [sys.executable, __file__, "--reader", reader, wanted, *map(str, paths)]
    found = []
    for _ in range(times):
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
        found.append([float(one) for one in done.stdout.split()[-2:]])
    return min(one[0] for one in found), max(one[1] for one in found)


def _used() -> tuple[float, float]:
    """Return the processor time (s) of this process and its children, and their largest memory (MB)."""
    parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in parts), max(one.ru_maxrss for one in parts) / 1e3


if __name__ == "__main__":
    main()
