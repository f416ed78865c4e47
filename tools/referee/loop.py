"""Run a bridge's navigation and an autopilot that uses its fixes in closed loop."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from math import hypot
from typing import NamedTuple

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.bridge.navigation import NavigationService
from magbridge.config import Link
from magbridge.field.geodesy import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.link.component import Component
from magbridge.link.estimates import FIX_MESSAGES
from magbridge.navigate import NavigationOptions
from magbridge.records import Corrected
from referee.autopilot import GPS_SIGMA, Autopilot, Truth

Place = tuple[float, float]
Receiver = Callable[[float, Place], tuple[Place, float] | None]
"""Function of the time (s since the start) and the true position (deg) that returns the measured position
and the accuracy (m) that the receiver claims, or None without a fix."""


def honest(second: float, place: Place) -> tuple[Place, float]:  # noqa: ARG001 - as the other receivers
    """Return the true position and accuracy, as an undisturbed receiver does."""
    return place, GPS_SIGMA


def outage(start: float, end: float, receiver: Receiver = honest) -> Receiver:
    """Return a receiver that has no reception between two times (s)."""
    return lambda second, place: None if start <= second < end else receiver(second, place)


def carried_off(start: float, north: float, east: float) -> Receiver:
    """Return a receiver whose position drifts away at a velocity (m/s) from the time `start` (s) on."""

    def measure(second: float, place: Place) -> tuple[Place, float]:
        elapsed = max(second - start, 0.0)
        return offset(*place, north * elapsed, east * elapsed), GPS_SIGMA

    return measure


def jumped(start: float, end: float, north: float, east: float) -> Receiver:
    """Return a receiver whose position is wrong by a constant (m) between two times (s)."""

    def measure(second: float, place: Place) -> tuple[Place, float]:
        wrong = start <= second < end
        return (offset(*place, north, east) if wrong else place), GPS_SIGMA

    return measure


def frozen(start: float, end: float) -> Receiver:
    """Return a receiver that repeats one position between two times (s)."""
    held: list[Place] = []

    def measure(second: float, place: Place) -> tuple[Place, float]:
        if not start <= second < end:
            return place, GPS_SIGMA
        held[:] = held or [place]
        return held[0], GPS_SIGMA

    return measure


def jammed(start: float, end: float, seed: int = 0, accuracy: float | None = None) -> Receiver:
    """Return a receiver that is jammed between two times (s), after ArduPilot's simulator.

    ``libraries/SITL/SIM_GPS.cpp``, simulate_jamming: no fix for 1 to 6 s. Then the number of satellites is
    drawn repeatedly, with a fix in 11 of 30 cases. The position starts where the jamming began and walks
    by up to 200 m on each axis about once a second. The accuracy is random between 0 and 300 m, or is the
    constant `accuracy`, m.
    """
    rng = np.random.default_rng(seed)
    silent = start + rng.uniform(1.0, 6.0)
    walk: list[Place] = []

    def measure(second: float, place: Place) -> tuple[Place, float] | None:
        if not start <= second < end:
            return place, GPS_SIGMA
        walk[:] = [offset(*(walk or [place])[0], *rng.uniform(-200.0, 200.0, 2).tolist())]
        claimed = accuracy if accuracy is not None else float(rng.uniform(0.0, 300.0))
        return (walk[0], claimed) if second > silent and rng.uniform() < 0.7 else None

    return measure


# ---- a bridge and an autopilot in closed loop --------------------------------------------------------------


SECOND_US = 1_000_000


class Run(NamedTuple):
    """Errors and states of bridge and autopilot, once a second (n,).

    `seconds` is the time since the start, `error` (m) the error of the bridge's position, NaN without one.
    `autopilot` (n, 2), m north and east, is the error of the autopilot's position, `claimed` (m) its 1-sigma
    on each axis. `sent` is the number of fixes so far, `state` the state of the bridge's navigator, `sigma`
    (m) the 1-sigma of the bridge's position (RMS of both axes), `gnss` the bridge's assessment of the
    receiver. `texts` are the bridge's STATUSTEXTs with their times, s since the start.
    """

    seconds: FloatArray
    error: FloatArray
    autopilot: FloatArray
    claimed: FloatArray
    sent: FloatArray
    state: FloatArray
    sigma: FloatArray
    gnss: FloatArray
    texts: list[tuple[float, str]]


def sail(
    flown: xr.Dataset,
    receiver: Receiver,
    grid: AnomalyGrid,
    options: NavigationOptions,
    kind: str,
    make: Callable[[tuple[float, float, float], int], Autopilot],
    seed: int = 0,
) -> tuple[Run, Autopilot, NavigationService]:
    """Run bridge and autopilot (from ``make(origin, start_us)``) over a track, with fixes of one `kind`.

    `flown` has evenly spaced samples with ``total_field`` and ``total_field_sigma`` (nT), ``truth_latitude``
    and ``truth_longitude`` (deg), ``depth`` (m), and ``velocity_north`` and ``velocity_east`` (m/s) through
    the water until the next sample.
    """
    start_us = round(float(flown["time"][0]) * 1e6) // 4 * 4
    component = Component(Link("udpout:127.0.0.1:14550"), {"MAG_NAVIGATION": -1.0}, start_us=start_us)
    navigation = NavigationService(grid, options, FIX_MESSAGES[kind], component)
    origin = float(flown["truth_latitude"][0]), float(flown["truth_longitude"][0]), 3.0
    autopilot = make(origin, start_us)
    rows: list[tuple[float, ...]] = []
    texts: list[tuple[float, str]] = []
    answers = b""
    columns = (flown[name].to_numpy().tolist() for name in ("time", "total_field", "total_field_sigma"))
    samples = deque(zip(*columns, strict=True))
    for seconds, truth in truths(flown, receiver, seed):
        now_us = start_us + round(seconds * SECOND_US) // 4 * 4
        for when_us, corrected in due(samples, now_us - 1):
            navigation.sample(when_us, corrected)
        component.output.advance(now_us)
        answers += exchange(component, autopilot)
        for message in component.receive(answers + autopilot.step(now_us, truth), now_us):
            navigation.receive(message, now_us)
        component.received.clear()
        for when_us, corrected in due(samples, now_us):
            navigation.sample(when_us, corrected)
        answers = exchange(component, autopilot)
        texts += [(seconds, text) for _, text in component.output.texts]
        component.output.texts.clear()
        off = separation(*truth.place, *autopilot.place)
        own, claimed = own_error(navigation, now_us, truth), autopilot.filter.sigma
        navigator = navigation.navigator
        sigma = float(np.sqrt(0.5 * np.trace(navigator.estimate.position_covariance)))
        states = float(navigator.estimate.state), sigma, float(navigator.gnss.state)
        rows.append((seconds, own, *off, claimed, navigation.fixing.sent, *states))
    table = np.array(rows)
    seconds, error, _, _, claimed, sent, state, sigma, gnss = table.T
    run = Run(seconds, error, table[:, 2:4], claimed, sent, state, sigma, gnss, texts)
    return run, autopilot, navigation


def due(samples: deque[tuple[float, float, float]], until_us: int) -> Iterator[tuple[int, Corrected]]:
    """Remove the samples (time in s, field and sigma in nT) until a time, and yield them."""
    while samples and samples[0][0] * 1e6 <= until_us:
        when, field, sigma = samples.popleft()
        yield round(when * 1e6), Corrected(field, sigma, (field, 0.0, 0.0), (sigma, sigma, sigma), 0)


def exchange(component: Component, autopilot: Autopilot) -> bytes:
    """Deliver the bridge's queued frames to the autopilot; return its replies."""
    return b"".join([autopilot.receive(frame, time_us) for time_us, frame in component.output.drain()])


def own_error(navigation: NavigationService, now_us: int, truth: Truth) -> float:
    """Return the distance between the bridge's position and the true position, m; NaN without a position."""
    navigator = navigation.navigator
    if not navigator.estimate.begun:
        return float("nan")
    north, east = navigator.estimate.x[:2].tolist()
    return hypot(*separation(*truth.place, *offset(*navigator.reckoned(now_us), north, east)))


def truths(flown: xr.Dataset, receiver: Receiver, seed: int) -> Iterator[tuple[float, Truth]]:
    """Yield time and true state of the vehicle every second, interpolated between the samples."""
    rng = np.random.default_rng(seed)
    time = flown["time"].to_numpy() - float(flown["time"][0])
    velocity = flown["velocity_north"].to_numpy(), flown["velocity_east"].to_numpy()
    heading, speed = np.degrees(np.arctan2(velocity[1], velocity[0])) % 360.0, np.hypot(*velocity)
    seconds = np.arange(0.0, time[-1])
    track = [flown[f"truth_{name}"] for name in ("latitude", "longitude")]
    places = zip(*(np.interp(seconds, time, one).tolist() for one in track), strict=True)
    noise = rng.normal(size=(len(seconds), 2)) * GPS_SIGMA
    depths = flown["depth"].to_numpy()
    for k, (second, place) in enumerate(zip(seconds.tolist(), places, strict=True)):
        i = int(second / time[1])
        measured = receiver(second, place)
        gps = offset(*measured[0], *noise[k].tolist()) if measured else None
        accuracy = measured[1] if measured else GPS_SIGMA
        yield second, Truth(place, float(speed[i]), float(heading[i]), 0.0, float(depths[i]), gps, accuracy)
