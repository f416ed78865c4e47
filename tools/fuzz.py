"""Damaged inputs for every parser and reader: a result, or one of our own errors; anything else is kept.

Seeds are what our own writers write. Each is damaged at random (bits, bytes, numbers, pieces moved, doubled,
cut off), and read as a user's file or line would be. A seed damages in one way; a run goes on where
the last of its folder stopped. With atheris (pip install atheris) ``--guided`` lets coverage choose.

    python tools/fuzz.py mavlink digitizer -n 1000000 -o fuzz
    python tools/fuzz.py --kind file --seconds 600 -o fuzz
    python tools/fuzz.py csv --guided -n 100000 -o fuzz
    python tools/fuzz.py --report -o fuzz
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import json
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from fuzz_seeds import SEEDS
from rich.console import Console
from studies import command_line, table

from magbridge.errors import MagbridgeError

LONGEST = 10.0
"""s of processor time that any input may take: these are far smaller than 10 MB."""
SAVE_EVERY = 1000
NUMBERS = [0, 1, 2, 3, 4, 7, 8, 127, 128, 254, 255]
WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"1e400",
    b"-9999",
    b"0",
    b",",
    b"\n",
    b"\0",
    b'"',
    b"\xff\xfe",
    b"\xef\xbb\xbf",
]

Read = Callable[[bytes], object]


class Target(NamedTuple):
    """A parser: ``kind`` "bytes" or "file", and what opens the function that is fed, given a folder."""

    kind: str
    open: Callable[[Path], Read]


def _driver(name: str, **options: Any) -> Target:
    def opened(_: Path) -> Read:
        from magbridge.sensors import open_driver

        def read(data: bytes) -> object:
            driver = open_driver(name, options)
            half = len(data) // 2
            return [driver.feed(data[:half]), driver.feed(data[half:])]

        return read

    return Target("bytes", opened)


def _mavlink(_: Path) -> Read:
    from magbridge.mavlink import BAD_DATA, Codec

    def read(data: bytes) -> object:
        """Parse in two chunks; every byte must be in a message, counted as skipped, or pending."""
        codec = Codec(1, 191)
        half = len(data) // 2
        messages = [*codec.parse(data[:half]), *codec.parse(data[half:])]
        skipped = sum(len(one.frame) for one in messages if one.id == BAD_DATA)
        if b"".join(one.frame for one in messages) + codec.pending != data:
            raise AssertionError("messages and pending bytes are not the bytes received")
        if skipped != codec.bytes_skipped or codec.frames != sum(one.id != BAD_DATA for one in messages):
            raise AssertionError("messages or skipped bytes are not counted")
        return [one.fields for one in messages if one.known]

    return read


def _frame_log(_: Path) -> Read:
    from magbridge.mavlink.tlog import LogReader

    return lambda data: [(record, record.message) for record in LogReader(BytesIO(data))]


def _calibration(_: Path) -> Read:
    from magbridge.calibration.file import decode_calibration

    return decode_calibration


def _file(name: str, reader: str) -> Target:
    """Return a target that writes the bytes to a file called `name` and reads it as a log, a grid or so."""

    def opened(folder: Path) -> Read:
        from magbridge import config, logs
        from magbridge.field import read

        path = folder / name
        how: Any = {
            "log": logs.read,
            "grid": read.read_grid,
            "polygon": read.read_polygon,
            "config": config.load,
        }
        function = how[reader]

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return function(path)

        return run

    return Target("file", opened)


TARGETS: dict[str, Target] = {
    "digitizer": _driver("digitizer", sensitivity=5e-5),
    "hmr2300": _driver("hmr2300", output="ascii"),
    "hmr2300-binary": _driver("hmr2300", output="binary"),
    "twinleaf": _driver("twinleaf", temperature="therm"),
    "ascii": _driver("ascii", columns=["x", "y", "z", "temperature"], unit="G"),
    "nmea": _driver(
        "ascii", prefix="$PMAG,", separator=",", columns=["time", "x", "y", "z"], checksum="nmea"
    ),
    "mavlink": Target("bytes", _mavlink),
    "frame_log": Target("bytes", _frame_log),
    "calibration": Target("bytes", _calibration),
    "config": _file("bridge.toml", "config"),
    "polygon": _file("mask.csv", "polygon"),
    "csv": _file("log.csv", "log"),
    "tlog": _file("log.tlog", "log"),
    "netcdf": _file("log.nc", "log"),
    "parquet": _file("log.parquet", "log"),
    "ardupilot": _file("log.BIN", "log"),
    "px4": _file("log.ulg", "log"),
    "slocum": _file("log.dbd", "log"),
    "table": _file("grid.csv", "grid"),
    "esri": _file("grid.asc", "grid"),
    "surfer": _file("grid.grd", "grid"),
    "geosoft": _file("grid.grd", "grid"),
    "geotiff": _file("grid.tif", "grid"),
    "grid-netcdf": _file("grid.nc", "grid"),
}


def damaged(seeds: list[bytes], rng: random.Random) -> bytes:
    """Return one of the seeds with one to eight damages."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        length = min(rng.choice((1, 2, 4, 8, 32, 256)), len(data) - at)
        match rng.randrange(9):
            case 0 if length:
                data[at] ^= 1 << rng.randrange(8)
            case 1 if length:
                data[at] = rng.choice(NUMBERS)
            case 2:
                data[at : at + length] = rng.randbytes(length)
            case 3:
                data[at:at] = rng.randbytes(length)
            case 4:
                del data[at : at + length]
            case 5:
                data[at:at] = data[at : at + length] * rng.choice((1, 2, 50))
            case 6:
                data[at : at + length] = rng.choice(WORDS)
            case 7:
                other = rng.choice(seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            case 8 if rng.random() < 0.3:
                del data[at:]
    return bytes(data)


class Session:
    """One target's folder: how many inputs were tried with what outcome, and the findings."""

    def __init__(self, name: str, folder: Path, seed: int) -> None:
        self.name, self.folder = name, folder / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self._state = self.folder / "state.json"
        begun = {
            "seed": seed,
            "tried": 0,
            "read": 0,
            "refused": 0,
            "found": 0,
            "seconds": 0.0,
            "slowest": 0.0,
        }
        self.state: dict[str, Any] = json.loads(self._state.read_text()) if self._state.exists() else begun
        self._began = time.monotonic() - self.state["seconds"]

    def run(self, read: Read, data: bytes) -> None:
        """Feed one input, count its outcome, keep it if that is neither a result nor one of our errors."""
        began = time.process_time()
        problem = ""
        try:
            read(data)
            self.state["read"] += 1
        except MagbridgeError as error:
            self.state["refused"] += 1
            if "\n" in str(error) or "cannot be read, damaged?" in str(error):  # it was not foreseen
                problem = f"{error}\n" + "\n".join(getattr(error, "__notes__", []))
        except Exception:  # noqa: BLE001 - that is what we look for
            problem = traceback.format_exc()
        took = time.process_time() - began
        self.state["slowest"] = max(self.state["slowest"], took)
        if took > LONGEST:
            problem = problem or f"took {took:.1f} s\n"
        self.state["tried"] += 1
        if problem:
            self._keep(data, problem)
        if self.state["tried"] % SAVE_EVERY == 0:
            self.save()

    def _keep(self, data: bytes, problem: str) -> None:
        """Keep an input whose problem, told by its last lines, is new."""
        lines = [line for line in problem.splitlines() if line.strip().startswith(("File", "took"))]
        kind = hashlib.sha1(
            "".join(lines[-2:] or [problem[:80]]).encode(), usedforsecurity=False
        ).hexdigest()[:10]
        if not (self.folder / f"{kind}.txt").exists():
            self.state["found"] += 1
            (self.folder / kind).write_bytes(data)
            (self.folder / f"{kind}.txt").write_text(problem)

    def save(self) -> None:
        """Write the counts."""
        self.state["seconds"] = round(time.monotonic() - self._began, 1)
        temporary = self._state.with_suffix(".partial")
        temporary.write_text(json.dumps(self.state, indent=1))
        temporary.replace(self._state)


def blind(session: Session, read: Read, seeds: list[bytes], count: int, seconds: float) -> None:
    """Damage the seeds at random; input k of a seed is the same in every run."""
    until = time.monotonic() + seconds
    for k in range(session.state["tried"], session.state["tried"] + count):
        session.run(read, damaged(seeds, random.Random(f"{session.state['seed']} {k}")))
        if time.monotonic() > until:
            break
    session.save()


def guided(session: Session, name: str, folder: Path, count: int) -> None:
    """Use coverage by atheris; useful inputs stays in the target's folder ``corpus``."""
    import atheris  # type: ignore[import-not-found,import-untyped,unused-ignore]  # optional, for this alone

    # imports here are watched: also that which the first reading imports
    with atheris.instrument_imports(include=["magbridge"]), contextlib.suppress(MagbridgeError):
        read = TARGETS[name].open(folder)
        read(b"")
    corpus = session.folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for k, seed in enumerate(SEEDS[name](folder)):
        (corpus / f"seed{k}").write_bytes(seed)
    options = [f"-runs={count}", f"-seed={session.state['seed'] + 1}", "-max_len=100000", "-verbosity=0"]

    def one(data: bytes) -> None:
        session.run(read, data)

    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atexit.register(session.save)
    atheris.Fuzz()


def report(folder: Path) -> None:
    """Print the counts of a folder's targets."""
    shown = table(
        "Fuzzing", "target", "tried", "read", "refused", "found", "a second", "slowest, s", left=("target",)
    )
    total = 0
    for path in sorted(folder.glob("*/state.json")):
        state = json.loads(path.read_text())
        total += state["tried"]
        rate = state["tried"] / max(state["seconds"], 0.1)
        counts = [f"{state[key]:,}" for key in ("tried", "read", "refused", "found")]
        shown.add_row(path.parent.name, *counts, f"{rate:,.0f}", f"{state['slowest']:.2f}")
    shown.add_row("all", f"{total:,}")
    Console().print(shown)


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as made:
        yield Path(made)


def main() -> None:
    """Fuzz the targets one after the other."""
    parser = command_line(__doc__)
    parser.add_argument("targets", nargs="*", help=f"which: {' '.join(TARGETS)}; default all")
    parser.add_argument("--kind", choices=["bytes", "file"], help="all targets of a kind")
    parser.add_argument("-n", type=int, default=10_000, help="inputs for each")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for each, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", type=Path, default=Path("fuzz"), help="folder of states and findings")
    parser.add_argument("--guided", action="store_true", help="by coverage (atheris); one target")
    parser.add_argument("--report", action="store_true", help="print the inputs tried, and stop")
    chosen = parser.parse_args()
    if chosen.report:
        report(chosen.o)
        return
    names = chosen.targets or [n for n, t in TARGETS.items() if chosen.kind in (None, t.kind)]
    for name in names:
        with _folder() as folder:
            session = Session(name, chosen.o, chosen.seed)
            if chosen.guided:
                guided(session, name, folder, chosen.n)
            else:
                read, seeds = TARGETS[name].open(folder), SEEDS[name](folder)
                blind(session, read, seeds, chosen.n, chosen.seconds)
    report(chosen.o)


if __name__ == "__main__":
    main()
