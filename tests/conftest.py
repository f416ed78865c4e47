"""What several rooms' tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of measured data, kept outside the project."""
    for candidate in (
        os.environ.get("MAGBRIDGE_REAL_DATA", ""),
        Path(__file__).parents[2] / "shared" / "data",
    ):
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    pytest.skip("no measured data: set MAGBRIDGE_REAL_DATA or put them in ../shared/data")
