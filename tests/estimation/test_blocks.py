"""Test the priors of parameter blocks."""

import numpy as np

from magbridge.estimation.blocks import MAX_PAUSE_S, SlowFunctions


def test_a_random_walk_has_one_rate_in_stretches_of_any_length() -> None:
    """The variance of a change over an hour is the same in a stretch of 4 hours and in one of 48."""
    short, long = np.arange(0.0, 4 * 3600.0, 60.0), np.arange(0.0, 48 * 3600.0, 60.0)
    waves = SlowFunctions(np.r_[short, short[-1] + 2 * MAX_PAUSE_S + long])
    change = waves[60 + np.r_[90, len(short) + 1400]] - waves[np.r_[90, len(short) + 1400]]
    four, forty_eight = np.sum((change * waves.shape) ** 2, axis=1)
    assert 0.5 < four / forty_eight < 2.0
