"""Fixture of the calibration tests: a cached function that makes a simulated glider."""

from functools import cache

import pytest
from gliders import Gliders, make


@pytest.fixture(scope="session")
def glider() -> Gliders:
    return cache(make)
