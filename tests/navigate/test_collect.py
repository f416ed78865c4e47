"""Samples of one measurement: their distance is at most the detail of the map."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, Collector
from magbridge.navigate.options import NavigationOptions

T0 = 1_600_000_000


def blocks(times: list[float], speed: float, step: float = 80.0, interval: float = 20.0) -> list[Block]:
    """Return the blocks of a straight leg eastward, sampled at `times` (s)."""
    collector, where = Collector(NavigationOptions(interval=interval), step), DeadReckoning()
    where.advance(float(T0))
    where.place(54.0, 10.0)
    where.telemetry(float(T0), {"velocity_north": 0.0, "velocity_east": speed})
    found = []
    for t in times:
        where.advance(T0 + t)
        found.append(collector.add(round((T0 + t) * 1e6), where, 50_000.0, 1.0))
    return [block for block in [*found, collector.flush()] if block is not None]


@pytest.mark.parametrize("interval", [20.0, 1.0, 0.0])
def test_where_a_step_is_longer_than_a_block_every_sample_is_one(interval: float) -> None:
    """At once, too: what a fast vehicle measures does not wait for the next sample."""
    made = blocks([float(k) for k in range(12)], speed=290.0, interval=interval)
    assert [block.time_us for block in made] == [(T0 + k) * 1_000_000 for k in range(12)]
    np.testing.assert_allclose([block.variance for block in made], 1.0)


def test_slow_samples_fill_a_block_and_do_not_overflow_it() -> None:
    """At 1 m/s and a block of 10 m: 11 samples span it, the twelfth begins the next."""
    made = blocks([float(k) for k in range(45)], speed=1.0, step=10.0)
    np.testing.assert_allclose([1.0 / block.variance for block in made], [1, 11, 11, 11, 11])


def test_after_a_gap_a_new_block_begins() -> None:
    times = [0.0, 1.0, 2.0, 3.0, 500.0, 501.0, 502.0]
    made = blocks(times, speed=1.0, step=10.0)
    spans = [[t for t in times if abs(T0 + t - block.time_us * 1e-6) < 3.0] for block in made]
    assert len(made) >= 3
    assert not any({3.0, 500.0} <= set(span) for span in spans)
    assert sum(1.0 / block.variance for block in made) == pytest.approx(len(times))
