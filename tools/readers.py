"""Measure how fast logs are read, compared with the usual libraries.

    python tools/readers.py [--times 3] --logs LOG...

Each reader runs in its own process, whose start and imports count; Slocum segments are read together. The
table has the processor time (all processes, least of several runs), its ratio, and the largest memory.
Third-party readers read the same content as far as their options allow: pymavlink and rosbags read
magbridge's messages, pyulog its topics, dbdreader its sensors, xarray all variables. Their processes do not
import magbridge, but get the names from this process.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from studies import DATA, command_line, show, table

from magbridge.logs import ardupilot, px4, rosbag, slocum, telemetry
from magbridge.logs.registry import FORMATS, format_of

BEGIN = """
import json, resource, sys
from pathlib import Path
wanted, paths = json.loads(sys.argv[1]), [Path(path) for path in sys.argv[2:]]
"""
END = """
parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
print(sum(one.ru_utime + one.ru_stime for one in parts), max(one.ru_maxrss for one in parts) / 1e3)
"""
OURS = """
from magbridge.logs import read_each
read_each(paths)
"""
MAVLINK = """
from pymavlink import mavutil
for path in paths:
    connection = mavutil.mavlink_connection(str(path))
    while connection.recv_match(type=wanted) is not None:
        pass
"""
NETCDF = """
import xarray as xr
for path in paths:
    xr.open_dataset(path, decode_times=False).load()
"""
ULOG = """
from pyulog import ULog
for path in paths:
    ULog(str(path), wanted)
"""
BAG = """
from rosbags.highlevel import AnyReader
for path in paths:
    with AnyReader([path]) as bag:
        chosen = [one for one in bag.connections if one.msgtype.replace("/msg/", "/") in wanted]
        for connection, _, data in bag.messages(connections=chosen):
            bag.deserialize(data, connection.msgtype)
"""
DBD = """
import dbdreader
partners = [path.with_suffix(wanted[0][path.suffix]) for path in paths if path.suffix in wanted[0]]
for path in [*paths, *partners]:
    file = dbdreader.DBD(str(path), cacheDir=str(path.parent))
    file.get(file.timeVariable, *(name for name in wanted[1] if name in file.parameterNames))
"""
PEERS: dict[str, tuple[str, str, Any]] = {
    "netcdf": ("xarray", NETCDF, None),
    "ardupilot": ("pymavlink", MAVLINK, [*ardupilot.WANTED]),
    "telemetry": ("pymavlink", MAVLINK, [*telemetry.MAVLINK_FIELDS, "NAMED_VALUE_FLOAT"]),
    "px4": ("pyulog", ULOG, [*px4.PX4_FIELDS, *px4.NEEDED_FIELDS]),
    "ros": ("rosbags", BAG, [*rosbag.MESSAGE_KINDS]),
    "slocum": ("dbdreader", DBD, [slocum.SCIENCE, [*slocum.SENSORS]]),
}
"""Library of each format, its program, and the names that magbridge reads, as the library expects them."""


def measure(script: str, wanted: Any, paths: list[Path], times: int) -> tuple[float, float]:
    """Return the least processor time (s) and the largest memory (MB) of several runs of a program."""
    command = [sys.executable, "-c", BEGIN + script + END, json.dumps(wanted), *map(str, paths)]
    found = []
    for _ in range(times):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found.append([float(one) for one in done.stdout.split()[-2:]])
    return min(one[0] for one in found), max(one[1] for one in found)


def main() -> None:
    """Print a row for each log, and for all Slocum segments together."""
    chosen = command_line(__doc__, times=3, logs=[DATA / "ardusub" / "small.tlog"])
    names = {id(form): name for name, form in FORMATS.items()}
    tasks: dict[tuple[str, Path | None], list[Path]] = {}
    for path in chosen.logs:
        name = names[id(format_of(path))]
        tasks.setdefault((name, None if name == "slocum" else path), []).append(path)
    shown = table("Readers", "log", "MB", "magbridge, s", "peer, s", "", "ratio", "memory, MB")
    for (name, _), paths in tasks.items():
        files = [file for path in paths for file in ([*path.iterdir()] if path.is_dir() else [path])]
        library, script, wanted = PEERS[name]
        mine, memory = measure(OURS, None, paths, chosen.times)
        theirs, _ = measure(script, wanted, paths, chosen.times)
        label = paths[0].name if len(paths) == 1 else f"{len(paths)} segments"
        numbers = f"{sum(file.stat().st_size for file in files) / 1e6:.0f}", f"{mine:.2f}", f"{theirs:.2f}"
        shown.add_row(label, *numbers, library, f"{mine / theirs:.2f}", f"{memory:.0f}")
    show(shown)


if __name__ == "__main__":
    main()
