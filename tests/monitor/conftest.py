"""What the tests of the page share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def clock(tmp_path: Path) -> Path:
    """By how many µs the page's computer's clock is set forward."""
    offset = tmp_path / "offset"
    offset.write_text("0")
    return offset
