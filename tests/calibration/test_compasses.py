"""A log of several compasses: a calibration for each in one call."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from flash import Log
from scipy.spatial.transform import Rotation

from magbridge.calibration.file import load
from magbridge.field.igrf import igrf

UTC = 1.7e9
OFFSETS = np.array([[30, -20, 10], [-150, 60, 200]])
"""mG, of two compasses."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log in which two compasses, and a third that is dead, saw every attitude."""
    log = Log()
    earth = igrf(np.array([-63.0]), np.array([45.0]), np.array([0.0]), np.array([UTC]))[0]
    for k, body in enumerate(Rotation.random(300, rng=np.random.default_rng(7)).inv().apply(earth) / 100.0):
        us = 5_000_000 + k * 100_000
        if k % 10 == 0:
            log.fix(us, UTC + us * 1e-6)
        for number, offset in enumerate(OFFSETS):
            log.mag(us, number, np.rint(body + offset).astype(int).tolist())
        log.mag(us, 2, (1, 2, 3), health=0)
    path = tmp_path_factory.mktemp("flight") / "flight.BIN"
    path.write_bytes(log.data)
    return path


def test_each_compass_gets_a_calibration_of_its_own(flight: Path, here: Path, command: Command) -> None:
    output = command("calibrate", flight, "--compass", "all", "-o", "cal.json", "--json")
    assert sorted(path.name for path in here.iterdir()) == ["cal_0.json", "cal_1.json"]
    assert "compass 2: " in output.err
    results = json.loads(output.out)["compasses"]
    assert list(results) == ["0", "1"]
    for number, result in enumerate(results.values()):
        assert result["file"] == f"cal_{number}.json"
        np.testing.assert_allclose(result["paper"]["T_nT"], 100 * OFFSETS[number], rtol=0, atol=60)
        assert result["rms_nT"] < 40  # steps of 100 nT: 29
        assert load(f"cal_{number}.json").inputs.keys() == {"flight.BIN"}


def test_every_option_holds_for_each_compass(flight: Path, command: Command) -> None:
    for which in ("1", "all"):
        asked = "calibrate", flight, "--compass", which, "--position-sigma", "10", "-o", "cal.json"
        assert "position_sigma: the log does not show the crustal field" in command(*asked, code=1).err


def test_one_compass_is_one_calibration(flight: Path, here: Path, command: Command) -> None:
    result = json.loads(command("calibrate", flight, "--compass", "1", "-o", "cal.json", "--json").out)
    np.testing.assert_allclose(result["paper"]["T_nT"], 100 * OFFSETS[1], rtol=0, atol=60)
    assert [path.name for path in here.iterdir()] == ["cal.json"]
