"""Gliders, each made once."""

from __future__ import annotations

from functools import cache

import pytest
from gliders import Gliders, make


@pytest.fixture(scope="session")
def glider() -> Gliders:
    return cache(make)
