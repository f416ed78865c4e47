"""Test a real aircraft's calibration flight: the claimed sigma is right at any sample rate."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import Command
from log_files import Log
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.file import load
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observations import Observations
from magbridge.calibration.fitting.uncertainty import in_sensor_units
from magbridge.calibration.heading import heading
from magbridge.estimation.residual import rms
from magbridge.field.igrf import igrf

pytestmark = pytest.mark.real

FLOWN = 1_592_611_200.0
"""Start of the day of the flight, 2020-06-20, s since 1970 UTC."""


@pytest.fixture(scope="module")
def line(real_data: Path) -> Observations:
    """Return the columns of the line at 10 Hz: time of day, fluxgate, pitch, roll, heading, IGRF."""
    rows = np.loadtxt(real_data / "magnav_flt1002" / "Flt1002_1002.02.txt")
    return Observations(
        rows[:, 1:4], np.linalg.norm(rows[:, 7:10], axis=1), np.empty((len(rows), 0)),
        time=FLOWN + rows[:, 0], attitude=np.radians(rows[:, [5, 4, 6]]), reference_ned=rows[:, 7:10],
    )  # fmt: skip


def halves_of(data: Observations, first: bool, step: int = 10) -> tuple[Observations, Observations]:
    """Return every `step`-th sample of the first or second half of a line, and of its other half."""
    data = data.part(np.arange(len(data)) % step == 0)
    half = (np.arange(len(data)) < len(data) // 2) == first
    return data.part(half), data.part(~half)


def test_the_claimed_sigma_does_not_depend_on_the_rate(line: Observations) -> None:
    """The sigma of the second half, corrected by a fit of the first half, is equal at 3.3 and 1 Hz."""
    sigmas = []
    for step in (3, 10):
        seen, other = halves_of(line, first=True, step=step)
        known = fit(seen, "nominal").calibration
        sigmas.append(rms(correct(known, other.field, other.parameters, other.time).sigma))
    assert max(sigmas) < 1.05 * min(sigmas)


@pytest.mark.parametrize(("first", "limit"), [(True, 1.5), (False, 3.0)])
def test_the_half_that_was_not_seen_bears_out_the_sigma(
    line: Observations, first: bool, limit: float
) -> None:
    """Eddy currents, crustal field and daily variation are missing in the model: 30 to 70 nT. No collapse.

    The second half is flown over smoother rock, and knows less of what the first one meets. What a user is
    told covers it, because the rock of the site is in it.
    """
    seen, other = halves_of(line, first)
    found = fit(seen)
    error, standardised = in_sensor_units(found.calibration, other)
    assert rms(error) < 80.0
    assert rms(standardised) < limit
    assert 0.85 < found.scales[0] < found.scales[1] < 1.05
    # the reference may be a main-field model without the crustal field
    known = fit(seen, site_bias=145.0).calibration
    corrected = correct(known, other.field, other.parameters, other.time)
    assert rms((corrected.total - other.reference) / corrected.sigma) < 0.6
    shrunk = [one for one in found.warnings if one.code == "unusual_scales"]
    assert len(shrunk) == (found.scales[1] < 0.95), "by 0.88 to 0.94, which few sensors need"


# ---- A log of several compasses: a calibration for each in one call --------------------------------------


UTC = 1.7e9
OFFSETS = np.array([[30, -20, 10], [-150, 60, 200]])
"""Offsets of two compasses, mG."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log in which two compasses, and a third dead compass, cover all attitudes."""
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


@pytest.mark.parametrize("first", [True, False])
def test_inertial_headings_in_the_fit_leave_a_quarter_of_a_degree(line: Observations, first: bool) -> None:
    seen, other = halves_of(line, first)
    known = fit(replace(seen, independent_headings=True)).calibration
    vector = correct(known, other.field, other.parameters, other.time).vector
    roll, pitch, truth = other.attitude.T
    declination = np.degrees(np.arctan2(other.reference_ned[:, 1], other.reference_ned[:, 0]))
    error = heading(vector, roll, pitch, declination).true - np.degrees(truth)
    assert rms((error + 180.0) % 360.0 - 180.0) < 0.26
