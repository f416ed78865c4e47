"""Fixture of the monitor's tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def clock(tmp_path: Path) -> Path:
    """Return a file with the shift (µs) of the clock of the page's computer, at first 0."""
    offset = tmp_path / "offset"
    offset.write_text("0")
    return offset
