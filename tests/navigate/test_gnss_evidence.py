"""Test the odds of a receiver's position by the field, at right and at false positions."""

import numpy as np
import pytest
from passages import AIRCRAFT, PLACE, START
from voyages import Map, synthetic

from magbridge.field.geodesy import offset
from magbridge.field.igrf import total_field
from magbridge.navigate import Navigator
from magbridge.navigate.gnss import GnssState

REPORTED, END = 100, 300
"""s: from the first on the receiver reports jamming, so that the navigator does not use its positions."""
DETECTED, OK = 3, 1


def gauss_markov(rng: np.random.Generator, count: int, sigma: float, seconds: float) -> np.ndarray:
    kept = np.exp(-1.0 / seconds)
    noise = sigma * np.sqrt(1.0 - kept**2) * rng.normal(size=count)
    values = np.empty(count)
    values[0] = sigma * rng.normal()
    for k in range(1, count):
        values[k] = kept * values[k - 1] + noise[k]
    return values


def log_odds(seed: int, shift: tuple[float, float]) -> np.ndarray:
    """Return the odds of map and position, (n, 2), each second after the report; `shift`: m, false from then.

    A plane at 22 m/s, with errors of map, calibration, wind and receiver as the options state.
    """
    rng, grid = np.random.default_rng(seed), synthetic(Map(120.0, 1000.0), seed)
    seconds = np.arange(END + 1)
    time, heading = START + seconds, np.full(seconds.size, 50.0 * seed)
    wind = np.stack([gauss_markov(rng, END + 1, 4.0, 3600.0) for _ in range(2)], axis=1)
    ahead = 22.0 * np.array([np.cos(np.radians(50.0 * seed)), np.sin(np.radians(50.0 * seed))])
    away = np.cumsum(ahead + wind, axis=0)
    away -= away.mean(axis=0)
    latitude, longitude = np.array([offset(*PLACE, *row) for row in away.tolist()]).T
    field = total_field(longitude, latitude, 0.0, time) + grid.evaluate(longitude, latitude).anomaly
    field += rng.normal(size=END + 1) + gauss_markov(rng, END + 1, 2.0, 21_600.0)
    field += gauss_markov(rng, END + 1, 2.0, 1000.0 / 22.0)
    error = np.stack([gauss_markov(rng, END + 1, 3.0, 30.0) for _ in range(2)], axis=1)
    error[REPORTED:] += shift
    navigator, found = Navigator(grid, AIRCRAFT), []
    for k in range(END + 1):
        now_us = int(time[k] * 1e6)
        navigator.telemetry(now_us, heading=float(heading[k]), speed=22.0)
        navigator.gnss.receive_integrity(now_us, DETECTED if k >= REPORTED else OK, OK)
        place = offset(float(latitude[k]), float(longitude[k]), *error[k].tolist())
        navigator.gnss_position(now_us, *place, 3.0)
        navigator.measure(now_us + 1, float(field[k]), 1.0)
        if k > REPORTED:
            assert navigator.gnss.state is not GnssState.GOOD
            evidence = navigator.gnss.evidence
            found.append((evidence.log_odds_of_map, evidence.log_odds_of_position))
    return np.array(found)


def test_the_odds_of_a_right_position_grow() -> None:
    """Of a likelihood ratio, the truth's share falls below 1/45 in 1 of 45 flights at most (Ville 1939)."""
    flights = [log_odds(seed, (0.0, 0.0)) for seed in range(1, 6)]
    assert min(odds[:, 1].min() for odds in flights) > -np.log(45.0)
    assert all(np.median(odds[60:, 0]) > 7.0 for odds in flights)
    assert np.median([odds[-1, 1] for odds in flights]) > 2.0


@pytest.mark.parametrize(("north", "east"), [(80.0, 60.0), (180.0, -240.0), (600.0, 800.0)])
def test_the_odds_of_a_false_position_fall(north: float, east: float) -> None:
    flights = [log_odds(seed, (north, east)) for seed in range(1, 4)]
    assert max(odds[:, 1].max() for odds in flights) < np.log(45.0)
    assert all(odds[60:, 1].max() < -2.0 for odds in flights)


@pytest.mark.parametrize("stated", [None, 20.0, 50.0])
def test_a_right_receiver_that_states_a_large_error_or_none_is_used(stated: float | None) -> None:
    """A slow vehicle on a smooth map, with a receiver that is better than it states."""
    rng, grid = np.random.default_rng(4), synthetic(Map(120.0, 600.0), 4)
    error = np.stack([gauss_markov(rng, 121, 2.0, 30.0) for _ in range(2)], axis=1)
    navigator = Navigator(grid, AIRCRAFT)
    for k in range(121):
        now_us = int((START + k) * 1e6)
        latitude, longitude = offset(*PLACE, 1.5 * k, 0.0)
        navigator.telemetry(now_us, heading=0.0, speed=1.5)
        navigator.gnss_position(now_us, *offset(latitude, longitude, *error[k].tolist()), stated)
        field = total_field(longitude, latitude, 0.0, START + k) + grid.evaluate(longitude, latitude).anomaly
        navigator.measure(now_us + 1, field.item() + rng.normal(), 1.0)
        assert navigator.gnss.state is GnssState.GOOD
