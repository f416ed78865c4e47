"""How long before each sample the others came."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.diagnose.survey import MAX_LAG, Past, Survey, assemble


def survey(time: np.ndarray, learned: np.ndarray | None = None) -> Survey:
    n = len(time)
    table = {name: np.full(n, 3e4) for name in ("mag_x", "mag_y", "mag_z", "reference_field")}
    learned = np.zeros(n) if learned is None else learned
    return assemble({**table, "time": time, "fitted": learned, "learned": learned}, {}, "log", ())


def test_a_step_is_what_a_quarter_of_the_samples_take_and_gaps_are_counted_in_it() -> None:
    """As a glider samples: every 5 s near the surface, 20 s below; one sample lost, and jitter."""
    near, below = np.full(40, 5.0), np.full(60, 20.0)
    below[30] = 40.0
    jitter = np.random.default_rng(1).uniform(-0.5, 0.5, 101)
    s = survey(np.cumsum(np.concatenate([[0.0], near, below])) + jitter)
    assert s.interval == pytest.approx(5.0, rel=0.05)
    expected = np.concatenate([[MAX_LAG], np.full(40, 1), np.full(60, 4)])
    expected[71] = 8
    assert s.steps.tolist() == expected.tolist()
    assert s.slots.tolist() == [0, *np.cumsum(expected[1:])]
    assert s.follows().tolist() == [k not in (0, 71) for k in range(101)]
    assert s.follows(1).tolist() == [k != 0 for k in range(101)]


def test_nothing_is_known_before_a_log_and_where_another_begins() -> None:
    n = 80
    s = survey(4.0 * np.arange(n), (np.arange(n) >= 50).astype(float))
    assert np.flatnonzero(s.steps == MAX_LAG).tolist() == [0, 50]
    assert np.flatnonzero(~s.history(3).whole).tolist() == [0, 1, 2, 50, 51, 52]
    assert s.history(3) is s.history(3)


def test_samples_next_to_a_gap_have_the_lags_of_those_that_are_there() -> None:
    past = Past(np.array([MAX_LAG, 1, 1, 3, 1, 1, MAX_LAG, 1]), 2)
    lags = {
        int(row): past.lags[pattern].tolist() for row, pattern in zip(past.rows, past.pattern, strict=True)
    }
    assert lags == {
        0: [MAX_LAG, MAX_LAG],
        1: [1, MAX_LAG],
        3: [3, 4],
        4: [1, 4],
        6: [MAX_LAG, MAX_LAG],
        7: [1, MAX_LAG],
    }
    assert np.flatnonzero(past.whole).tolist() == [2, 5]
