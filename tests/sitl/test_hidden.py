"""``[[hidden]]`` in a scenario: what happens to a vehicle after its calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magbridge.columns import CHANNELS
from magbridge.errors import ConfigError, WrongUse
from sitl import load, segments, simulate
from sitl.mission import CrissCross, Spirals
from sitl.scenario import SCENARIOS, Scenario


def short(name: str) -> Scenario:
    """Return a built-in scenario with half an hour of survey."""
    return load(name).replace(mission=(Spirals(duration=120.0), CrissCross(hours=0.5)))


@pytest.mark.parametrize("name", ["bolt", "pump", "battery"])
def test_it_shows_in_its_segment_alone(name: str) -> None:
    """Before, nothing is changed; then, as much as its size allows."""
    scenario = short(name)
    changed = segments(simulate(scenario, 3))
    harmless = scenario.replace(hidden=())
    plain = segments(simulate(harmless, 3))
    for axis in CHANNELS:
        np.testing.assert_array_equal(changed["calibration"][axis], plain["calibration"][axis])
    off = max(
        float(np.abs(changed["survey"][a] - plain["survey"][a]).max()) for a in ("mag_x", "mag_y", "mag_z")
    )
    assert 5.0 < off < 100.0


def test_an_unknown_effect_is_one_line(tmp_path: Path) -> None:
    """It names the key and what there is."""
    text = (SCENARIOS / "bolt.toml").read_text(encoding="utf-8").replace("offset_step", "gremlin")
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"hidden.effect: expected one of temperature_offset.* not gremlin"):
        load(tmp_path / "mine.toml")


def test_a_segment_that_is_not_flown_is_refused() -> None:
    """An effect without a place would be no effect."""
    scenario = load("bolt").replace(mission=(Spirals(duration=120.0),))
    with pytest.raises(WrongUse, match="no segment 'survey'"):
        simulate(scenario, 1)
