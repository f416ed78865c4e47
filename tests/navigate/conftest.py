"""Fixtures of the navigation tests: options, and a map of the tool that prints the documented tables."""

import pytest
from voyages import Map, synthetic

from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.options import NavigationOptions


@pytest.fixture(scope="session")
def options() -> NavigationOptions:
    return NavigationOptions(start_sigma=200.0, current_sigma=0.05, bias_sigma=1.0, map_sigma=1.0)


@pytest.fixture(scope="session")
def grid() -> AnomalyGrid:
    """Return a map of 30 nT RMS and 1,500 m correlation length."""
    return synthetic(Map(30, 1500), 3)
