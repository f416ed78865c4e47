"""Fixtures of the MAVLink tests: the bridge's component connected to a ground station."""

from types import ModuleType

import pytest
from line import Line, MakeLine


@pytest.fixture
def link(peer: ModuleType) -> Line:
    one = Line(peer)
    one.to(0.1)
    return one


@pytest.fixture
def make_link(peer: ModuleType) -> MakeLine:
    return lambda **options: Line(peer, **options)
