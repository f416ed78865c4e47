"""Put faults of sensor, telemetry and computer into a survey, and count the wrong samples without a flag.

    python3 tools/faults.py                                   each fault on a simulated survey
    python3 tools/faults.py --faults none --hours 24 --seeds 30   30 days without a fault: false alarms

The glider of ``magbridge demo`` performs calibration spirals and a survey. The bridge processes the survey's
bytes with a fault in them. A sample is wrong if it has no flag and its error exceeds three sigmas.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr
from studies import Column, Row, Study
from study_worlds import MASSES

from magbridge import fit, observations, save
from magbridge.arrays import FloatArray
from magbridge.bridge.events import Event, StartEvent, standstill
from magbridge.bridge.pipeline import set_up
from magbridge.calibration.fitting.observations import unfiltered
from magbridge.columns import CHANNELS
from magbridge.config import load as load_config
from magbridge.records import Channel, Quality
from sitl import load, segments, simulate
from sitl.mission import CrissCross
from sitl.replay.emulation import emulate, start_us
from sitl.replay.listener import Listener
from sitl.replay.setup import bridge_toml

FAULT_AT = 0.27
"""Fraction of the survey after which a fault of kind `late` begins."""
Rows = xr.Dataset
Events = Iterator[Event]


@dataclass(frozen=True)
class Flight:
    """Survey of a calibrated glider: folder with ``bridge.toml`` and ``cal.json``, and rows of the log."""

    folder: Path
    survey: xr.Dataset


@dataclass(frozen=True)
class Score:
    """Result of a survey: numbers of samples, the largest error (nT) without a flag, the reported texts.

    A sample is `wrong` if it has no flag and an error above three sigmas. `sigma` is the median sigma of the
    samples without a flag, nT.
    """

    samples: int
    flagged: int
    wrong: int
    worst: float
    sigma: float
    reported: tuple[str, ...]


def prepare(folder: Path, seed: int, hours: float, *, calibrated_by: int | None = None) -> Flight:
    """Simulate a glider, fit its calibration (or another glider's, by its seed), write the bridge's files."""
    scenario = load("demo")
    survey = CrissCross(hours=hours, roll=(1.0, 2.0))
    deployment = simulate(scenario.replace(mission=(scenario.mission[0], survey)), seed)
    parts = segments(deployment)
    if calibrated_by is None:
        training = parts["calibration"]
    else:
        training = segments(simulate(scenario, calibrated_by))["calibration"]
    corner = scenario.instrument.corner
    found = fit(unfiltered(observations(training, MASSES), corner), "auto")
    folder.mkdir(parents=True, exist_ok=True)
    save(found.calibration, folder / "cal.json")
    (folder / "bridge.toml").write_text(bridge_toml(deployment, MASSES, calibrated=True), encoding="utf-8")
    return Flight(folder, parts["survey"])


def score(flight: Flight, rows: xr.Dataset, change: Callable[[Events], Events] = iter) -> Score:
    """Feed the events of `rows`, altered by `change`, to the bridge; compare its output with the truth."""
    config = load_config(flight.folder / "bridge.toml")
    pipeline = set_up(config, StartEvent(start_us(rows)))
    listener = Listener()
    for event in change(emulate(rows, config)):
        sent = pipeline.feed(event)
        if sent:
            listener.receive(b"".join(frame for _, frame in sent))
    field = listener.field()
    truth = np.interp(field["time"], flight.survey["time"], flight.survey["truth_total_field"])
    error = np.abs(field["total_field"] - truth)
    plain = (field["quality"].astype(int) & ~int(Quality.NO_BORESIGHT)) == 0
    wrong = plain & ~(error <= 3.0 * field["sigma"])
    worst, sigma = 0.0, 0.0
    if plain.any():
        worst, sigma = float(error[plain].max()), float(np.median(field["sigma"][plain]))
    flagged = len(plain) - int(plain.sum())
    return Score(len(plain), flagged, int(wrong.sum()), worst, sigma, tuple(listener.texts))


# -- faults: rows in, rows out -----------------------------------------------------------------------------


def fault_of(
    *channels: str, by: Callable[[FloatArray, FloatArray], FloatArray] | None, late: bool = False
) -> Callable[[Rows], Rows]:
    """Return a fault that replaces the values of channels by ``by(values, seconds)``, or freezes them.

    A `late` fault begins at `FAULT_AT`, any other fault at the start.
    """

    def fault(rows: Rows) -> Rows:
        seconds = rows["time"].to_numpy() - float(rows["time"][0])
        from_here = seconds >= (FAULT_AT * seconds[-1] if late else 0.0)
        changed = {}
        for name in channels:
            values = rows[name].to_numpy()
            held = np.full_like(values, values[np.argmax(from_here)])
            faulty = by(values, seconds) if by is not None else held
            changed[name] = ("time", np.where(from_here, faulty, values), rows[name].attrs)
        return rows.assign(changed)

    return fault


def spikes(values: FloatArray, _: FloatArray) -> FloatArray:
    """Return the values with 3 % of them shifted by 500 nT."""
    hit = np.random.default_rng(5).random(len(values)) < 0.03
    return np.asarray(values + np.where(hit, 500.0, 0.0))


def silent(rows: Rows) -> Rows:
    """Remove the masses' telemetry in 25 of every 60 s."""
    seconds = rows["time"].to_numpy() - float(rows["time"][0])
    heard = seconds % 60 >= 25
    return rows.assign({n: ("time", np.where(heard, rows[n], np.nan), rows[n].attrs) for n in MASSES})


def late(rows: Rows) -> Rows:
    """Delay the masses' telemetry by 2 s."""
    time = rows["time"].to_numpy()
    return rows.assign({n: ("time", np.interp(time - 2.0, time, rows[n]), rows[n].attrs) for n in MASSES})


def with_motion(rows: Rows) -> Rows:
    """Shift the offset of x by 100 nT at the moment at which a mass moves and the course changes."""
    moves = np.abs(np.diff(rows["battpos"].to_numpy())) > 0.01 * np.ptp(rows["battpos"].to_numpy())
    late = np.arange(len(moves)) > FAULT_AT * len(moves)
    begin = int(np.argmax(moves & late)) + 1
    values = rows["mag_x"].to_numpy() + np.where(np.arange(len(moves) + 1) >= begin, 100.0, 0.0)
    return rows.assign({"mag_x": ("time", values, rows["mag_x"].attrs)})


def noise(values: FloatArray, _: FloatArray) -> FloatArray:
    """Return the values with noise of 20 nT, twenty times the instrument's."""
    seed = int(abs(values[0]))  # a different seed for each channel
    return np.asarray(values + np.random.default_rng(seed).normal(0.0, 20.0, len(values)))


def hum(size: float, period: float) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return a fault that adds a sine of amplitude `size` (nT) and `period` (s)."""
    return lambda v, t: np.asarray(v + size * np.sin(2.0 * np.pi * t / period))


FAULTS: dict[str, Callable[[Rows], Rows]] = {
    "none": lambda rows: rows,
    "scaled by a thousandth": fault_of(*CHANNELS, by=lambda v, _: v / 1000),
    "polarity of x": fault_of("mag_x", by=lambda v, _: -v),
    "polarity of y": fault_of("mag_y", by=lambda v, _: -v),
    "polarity of z": fault_of("mag_z", by=lambda v, _: -v),
    "polarity of all axes": fault_of(*CHANNELS, by=lambda v, _: -v),
    "x stuck": fault_of("mag_x", by=None, late=True),
    "y stuck": fault_of("mag_y", by=None, late=True),
    "z stuck": fault_of("mag_z", by=None, late=True),
    "telemetry frozen, stamps advance": fault_of(*MASSES, by=None, late=True),
    "clips below its range": fault_of(
        *CHANNELS, by=lambda v, _: np.clip(v, -0.97 * np.abs(v).max(), 0.97 * np.abs(v).max())
    ),
    "telemetry silent 25 of 60 s": silent,
    "ballast's sign": fault_of("ballast", by=lambda v, _: -v),
    "ballast's unit": fault_of("ballast", by=lambda v, _: v / 1000),
    "gain +2 %": fault_of(*CHANNELS, by=lambda v, _: v * 1.02),
    "gain +1 %": fault_of(*CHANNELS, by=lambda v, _: v * 1.01),
    "gain of x +2 %": fault_of("mag_x", by=lambda v, _: v * 1.02),
    "gain of y +2 %": fault_of("mag_y", by=lambda v, _: v * 1.02),
    "gain +2 % on the way": fault_of(*CHANNELS, by=lambda v, _: v * 1.02, late=True),
    "spikes of 500 nT": fault_of("mag_x", by=spikes),
    "telemetry 2 s late": late,
    "offset of x +100 nT": fault_of("mag_x", by=lambda v, _: v + 100.0, late=True),
    "offset of z +100 nT": fault_of("mag_z", by=lambda v, _: v + 100.0, late=True),
    "offset of x +100 nT with a motion": with_motion,
    "drift of z, 20 nT/h": fault_of(
        "mag_z", by=lambda v, t: v + 20.0 * (t - FAULT_AT * t[-1]) / 3600.0, late=True
    ),
    "steps of 100 nT": fault_of(*CHANNELS, by=lambda v, _: 100.0 * np.round(v / 100.0), late=True),
    "noise times 20": fault_of(*CHANNELS, by=noise, late=True),
    "hum of 30 nT, 37 s": fault_of(*CHANNELS, by=hum(30.0, 37.0), late=True),
    "hum of 10 nT, 90 s": fault_of("mag_z", by=hum(10.0, 90.0), late=True),
    "hum of 10 nT, 150 s": fault_of("mag_z", by=hum(10.0, 150.0), late=True),
}


def stalls(length_us: int, every_us: int = 600_000_000) -> Callable[[Events], Events]:
    """Return a function that delays events as a process does that pauses `length_us` in every `every_us`."""

    def change(events: Events) -> Events:
        waiting: list[Event] = []
        first_us = end_us = 0
        for event in events:
            first_us = first_us or event.time_us
            since = (event.time_us - first_us) % every_us
            if since < length_us and event.time_us - first_us > every_us:
                end_us = event.time_us - since + length_us & ~3
                waiting.append(event)
                continue
            if waiting:
                yield Event(end_us, Channel.STATE, standstill(end_us, length_us))
                for channel in (Channel.LINK, Channel.SENSOR):  # the order of the live bridge
                    if data := b"".join(one.data for one in waiting if one.channel == channel):
                        yield Event(end_us, channel, data)
                waiting = []
            yield event

    return change


STALLS = {f"stands still for {seconds} s every 100 s": seconds for seconds in (1.5, 8.0)}
OTHER = "another glider's calibration"


@cache
def flight_of(seed: int, hours: float, calibrated_by: int | None) -> tuple[Flight, object]:
    """Return a prepared flight, and the temporary folder that holds its files."""
    folder = tempfile.TemporaryDirectory()
    return prepare(Path(folder.name), seed, hours, calibrated_by=calibrated_by), folder


def run(fault: str, seed: int, hours: float) -> list[Row]:
    """Simulate one glider with one fault; return the row."""
    flight, _ = flight_of(seed, hours, seed + 100 if fault == OTHER else None)
    rows = FAULTS[fault](flight.survey) if fault in FAULTS else flight.survey
    pause = STALLS.get(fault)
    change = stalls(round(pause * 1e6), 100_000_000) if pause else iter
    found = score(flight, rows, change)
    words = ("field", "axis", "noise")
    texts = [t for t in found.reported if any(w in t for w in words) and not t.startswith("field: ")]
    return [
        {
            "samples": found.samples, "flagged": found.flagged / found.samples,
            "wrong": found.wrong / found.samples, "worst": found.worst, "sigma": found.sigma,
            "messages": " | ".join(dict.fromkeys(texts))[:120],
        }
    ]  # fmt: skip


STUDY = Study(
    run,
    ("fault", "messages"),
    {
        "samples": Column("samples", np.sum, ".0f"),
        "flagged": Column("flagged", np.mean, ".1%"),
        "wrong": Column("wrong", np.mean, ".2%"),
        "largest error, nT": Column("worst", np.max, ".0f"),
        "sigma, nT": Column("sigma", form=".1f"),
    },
)


if __name__ == "__main__":
    faults = [*FAULTS, *STALLS, OTHER]
    STUDY.main(__doc__, faults=faults, seeds=1, first=1, hours=6.0)
