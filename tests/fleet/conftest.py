"""A fleet of two small vehicles, flown once."""

from __future__ import annotations

from pathlib import Path

import pytest
from fleets import FLEET, fly


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a fleet.toml and its logs."""
    folder = tmp_path_factory.mktemp("fleet")
    for vehicle, name, number in ((1, "one/first", 0), (1, "one/second", 1), (2, "two/first", 0)):
        fly(folder / f"{name}.nc", vehicle, number)
    (folder / "fleet.toml").write_text(FLEET)
    return folder
