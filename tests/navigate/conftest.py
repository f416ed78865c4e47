"""Maps and voyages, drawn by the same tool that prints the tables."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.model import Options


@pytest.fixture(scope="session")
def study() -> Iterator[ModuleType]:
    """tools/voyages/simulated.py, with the others beside it."""
    tools = str(Path(__file__).parents[2] / "tools")
    sys.path.insert(0, tools)
    yield import_module("voyages.simulated")
    sys.path.remove(tools)


@pytest.fixture(scope="session")
def options() -> Options:
    return Options(start_sigma=200.0, current_sigma=0.05, bias_sigma=1.0, map_sigma=1.0)


@pytest.fixture(scope="session")
def grid(study: ModuleType) -> AnomalyGrid:
    """30 nT rms, 1,500 m."""
    made: AnomalyGrid = study.synthetic(study.Map(30, 1500), 3)
    return made
