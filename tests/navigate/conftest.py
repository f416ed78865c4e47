"""Maps and voyages, drawn by the same tool that prints the tables."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from magbridge.field.grid import AnomalyGrid
from magbridge.navigate.model import Options


@pytest.fixture(scope="session")
def study() -> ModuleType:
    spec = spec_from_file_location("navigation", Path(__file__).parents[2] / "tools" / "navigation.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["navigation"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def options() -> Options:
    return Options(start_sigma=200.0, current_sigma=0.05, bias_sigma=1.0, map_sigma=1.0)


@pytest.fixture(scope="session")
def grid(study: ModuleType) -> AnomalyGrid:
    """30 nT rms, 1,500 m."""
    made: AnomalyGrid = study.synthetic(study.Map(30, 1500), 3)
    return made
