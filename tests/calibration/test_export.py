"""Test exported calibrations: C code gives Python's field, and the autopilots' formulae give theirs."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import correct
from magbridge.calibration.export_c import c_header, c_source
from magbridge.calibration.export_compass import (
    ardupilot,
    compass_of,
    heading_cost,
    position_table,
    px4,
    seaglider,
)
from magbridge.calibration.file import save
from magbridge.calibration.heading import heading
from magbridge.calibration.model import (
    Boresight,
    CalibratedRange,
    Calibration,
    Noise,
    Parameter,
    Reference,
    identity,
)
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.cli import main
from magbridge.correction import Correction
from magbridge.records import Quality, Reading

GCC = shutil.which("gcc") or shutil.which("cc")


def made(*parameters: Parameter, order: int = 3, turned: bool = True) -> Calibration:
    """Return a calibration with random coefficients and covariance."""
    random = np.random.default_rng(1)
    term = Polynomial(exponents=full_order(len(parameters), order))
    size = term.size
    coefficients = random.normal(0.0, 300.0, size)
    root = random.normal(0.0, 2.0, (size, size)) / np.sqrt(size)
    small = ((1e-4, 1e-5, 0.0), (1e-5, 2e-4, 0.0), (0.0, 0.0, 3e-4))
    return replace(
        identity(),
        parameters=parameters,
        terms=(term,),
        coefficients=coefficients,
        covariance=root @ root.T,
        boresight=Boresight((0.02, -0.03, 0.1), small) if turned else None,
        method="auto",
    )


def compiled(calibration: Calibration, folder: Path, *flags: str) -> ctypes.CDLL:
    if GCC is None:
        pytest.skip("no C compiler is installed")
    (folder / "magbridge_calibration.h").write_text(c_header(calibration))
    (folder / "magbridge_calibration.c").write_text(c_source(calibration))
    library = folder / f"calibration{'_'.join(flags)}.so"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-ffp-contract=off"]
    source = str(folder / "magbridge_calibration.c")
    subprocess.run([GCC, *strict, *flags, "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    return ctypes.CDLL(str(library))


def in_c(
    library: ctypes.CDLL, kind: Any, field: np.ndarray, values: np.ndarray, conditions: Any = None
) -> np.ndarray:
    """Return total, its sigma, vector, its sigmas, and whether the sample is extrapolated (n, 9)."""

    class Corrected(ctypes.Structure):
        _fields_ = [
            *[(name, kind) for name in ("total", "total_sigma")],
            *[(name, kind * 3) for name in ("field", "field_sigma")],
            ("extrapolated", ctypes.c_int),
        ]

    out, rows = Corrected(), []
    conditions = np.empty((len(field), 0)) if conditions is None else conditions
    for h, x, c in zip(field, values, conditions, strict=True):
        inputs = (kind * 3)(*h), (kind * max(len(x), 1))(*x), (kind * max(len(c), 1))(*c)
        library.magbridge_correct(*inputs, ctypes.byref(out))
        rows.append([out.total, out.total_sigma, *out.field, *out.field_sigma, out.extrapolated])
    return np.array(rows)


BATTPOS = Parameter("battpos", "in", -1.0, 1.0, 0.1, 0.8)
TWO = BATTPOS, Parameter("ballast", "cm3", -200.0, 200.0, 5.0, 150.0)
PITCH = Parameter("pitchCtl", "cm", -8.0, 2.0, -3.0, 5.0)


@pytest.mark.parametrize("parameters", [(), TWO[:1], TWO], ids=len)
@pytest.mark.parametrize("turned", [True, False])
def test_c_gives_what_python_gives(parameters: tuple[Parameter, ...], turned: bool, tmp_path: Path) -> None:
    calibration = made(*parameters, turned=turned)
    random = np.random.default_rng(5)
    field = random.normal(size=(200, 3))
    field *= 50_000.0 / np.linalg.norm(field, axis=1)[:, None]
    low, high = (np.array([getattr(one, end) for one in parameters]) for end in ("low", "high"))
    values = low + (high - low) * random.uniform(-0.1, 1.1, (200, len(parameters)))
    ours = correct(calibration, field, values, np.zeros(200))
    expected = np.column_stack([ours.total, ours.sigma, ours.vector, ours.vector_sigma])
    library = compiled(calibration, tmp_path)
    double = in_c(library, ctypes.c_double, field, values)
    np.testing.assert_allclose(double[:, [0, 2, 3, 4]], expected[:, [0, 2, 3, 4]], rtol=0, atol=1e-7)
    np.testing.assert_allclose(double[:, [1, 5, 6, 7]], expected[:, [1, 5, 6, 7]], rtol=1e-6)
    np.testing.assert_array_equal(double[:, 8], ours.quality & Quality.EXTRAPOLATED != 0)
    single = in_c(compiled(calibration, tmp_path, "-DMAGBRIDGE_FLOAT"), ctypes.c_float, field, values)
    np.testing.assert_allclose(single[:, [0, 2, 3, 4]], expected[:, [0, 2, 3, 4]], rtol=0, atol=0.05)
    np.testing.assert_allclose(single[:, [1, 5, 6, 7]], expected[:, [1, 5, 6, 7]], rtol=2e-2)
    for missing in (field[:1] * np.nan, values[:1]), (field[:1], values[:1] * np.nan):
        unknown = in_c(library, ctypes.c_double, *missing)
        assert np.isnan(unknown[0, 0]) == np.isnan([*missing[0].flat, *missing[1].flat]).any()


def test_c_widens_sigma_outside_the_conditions_of_the_fit(tmp_path: Path) -> None:
    """Depths and temperatures inside, outside and unknown; the temperature has a single value in the fit."""
    ranges = CalibratedRange("depth", 50.0, 90.0), CalibratedRange("sensor_temperature", 15.0, 15.0)
    known = replace(
        made(*TWO), conditions=ranges, reference=Reference(50_000.0, level_sigma=3.0), noise=Noise(sensor=2.0)
    )
    random, n = np.random.default_rng(6), 100
    field, values = random.normal(0.0, 30_000.0, (n, 3)), random.uniform([-1.0, -200.0], [1.0, 200.0], (n, 2))
    conditions = np.column_stack([random.uniform(0.0, 200.0, n), random.uniform(5.0, 25.0, n)])
    conditions[random.uniform(size=(n, 2)) < 0.2] = np.nan
    expected = []
    for h, x, (depth, temperature) in zip(field, values, conditions, strict=True):
        correction = Correction(known)
        for name, value in zip(("battpos", "ballast"), x, strict=True):
            correction.telemetry(name, value, 10**15)
        reading = Reading(tuple(h), temperature=temperature)
        ours = correction.reading(reading, 10**15, depth=depth)[1]
        extrapolated = bool(ours.quality & Quality.EXTRAPOLATED)
        expected.append([ours.total_field, ours.stated_sigma, *ours.field, *ours.field_sigma, extrapolated])
    found = in_c(compiled(known, tmp_path), ctypes.c_double, field, values, conditions)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


def read_parameters(text: str) -> dict[str, float]:
    rows = [line.replace("\t", ",").split(",") for line in text.splitlines() if not line.startswith("#")]
    return {row[-2] if len(row) == 2 else row[2]: float(row[-1] if len(row) == 2 else row[3]) for row in rows}


CURRENT = Parameter("battery_current", "A", 0.0, 20.0, 0.0, 20.0)


@pytest.mark.parametrize("current", [False, True])
def test_autopilots_correct_as_we_do(current: bool) -> None:
    """The formulae from the autopilots' source agree with magbridge on a calibration that they can hold."""
    calibration = made(*([CURRENT] if current else []), order=1, turned=False)
    if current:  # a current has a field of its own, and leaves the scales alone
        coefficients = calibration.coefficients.copy()
        coefficients[9:15] = 0.0
        calibration = replace(calibration, coefficients=coefficients)
    compass = compass_of(calibration)
    assert compass.lost == ("uncertainties and flags",)
    field, ampere = np.array([21_000.0, -5_000.0, 44_000.0]), 12.0 if current else 0.0
    channels = np.array([[ampere]] if current else [[]])
    ours = correct(calibration, field[None], channels, np.zeros(1)).vector[0]

    def vector(found: dict[str, float], name: str, axes: str = "XYZ") -> np.ndarray:
        return np.array([found.get(name.format(axis), 0.0) for axis in axes])

    def matrix(diagonal: np.ndarray, off: np.ndarray) -> np.ndarray:
        (a, b, c), (d, e, f) = diagonal, off
        return np.array([[a, d, e], [d, b, f], [e, f, c]])

    found = read_parameters(ardupilot(compass)[0])
    M = matrix(vector(found, "COMPASS_DIA_{}"), vector(found, "COMPASS_ODI_{}"))
    theirs = M @ (field / 100.0 + vector(found, "COMPASS_OFS_{}")) + vector(found, "COMPASS_MOT_{}") * ampere
    np.testing.assert_allclose(theirs * 100.0, ours, atol=0.01)
    found = read_parameters(px4(compass, 1))
    M = matrix(vector(found, "CAL_MAG1_{}SCALE"), vector(found, "CAL_MAG1_{}ODIAG"))
    power = vector(found, "CAL_MAG1_{}COMP") * ampere * 1e-3
    theirs = M @ (field / 1e5 + power - vector(found, "CAL_MAG1_{}OFF"))
    np.testing.assert_allclose(theirs * 1e5, ours, atol=0.01)


def test_a_current_gets_the_best_line_of_its_calibrated_range() -> None:
    """Noise bends a cubic whose field is linear over 2 to 18 A; its tangent at 0 A is an extrapolation."""
    slopes, noise, n = np.array([40.0, -20.0, 30.0]), 50.0, 1_000
    current = np.linspace(2.0, 18.0, n)
    offset = np.outer(current, slopes) + np.random.default_rng(1).normal(0.0, noise, (n, 3))
    coefficients = np.zeros((4, 9))
    coefficients[:, 6:] = np.polynomial.polynomial.polyfit((current - 10.0) / 8.0, offset, 3)
    calibration = made(Parameter("battery_current", "A", 2.0, 18.0, 10.0, 8.0), turned=False)
    compass = compass_of(replace(calibration, coefficients=coefficients.ravel()))
    sigma = noise / (np.sqrt(n) * current.std())
    found = read_parameters(ardupilot(compass)[0]) | read_parameters(px4(compass))
    for name in ("COMPASS_MOT_{}", "CAL_MAG0_{}COMP"):  # -dT/dI in mG/A and G/kA
        slope = [-100.0 * found[name.format(axis)] for axis in "XYZ"]
        np.testing.assert_allclose(slope, slopes, rtol=0, atol=4.0 * sigma)
    curve, *_ = compass.lost
    assert curve.startswith("the field of the current beyond a straight line: up to ")
    assert int(curve.split("up to ")[1].split()[0]) < 10.0 * noise / np.sqrt(n)


def test_what_an_autopilot_cannot_hold_is_reported() -> None:
    lost = " ".join(compass_of(made(*TWO)).lost)
    assert "the field of battpos, ballast: up to " in lost
    assert "the boresight, a turn of 6.1 deg" in lost


def seaglider_heading(text: str, counts: np.ndarray, roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Return headings (n,), deg, as a basestation computes them from counts, roll and pitch (rad)."""
    hard, soft = (np.array(line.split('"')[1].split(), float) for line in text.splitlines())
    m = counts * [1.0, -1.0, -1.0] - hard
    p = m @ soft.reshape(3, 3).T
    x = p[:, 0] * np.cos(pitch) - p[:, 1] * np.sin(pitch) * np.sin(roll)
    x -= p[:, 2] * np.sin(pitch) * np.cos(roll)
    return np.degrees(np.arctan2(p[:, 1] * np.cos(roll) - p[:, 2] * np.sin(roll), x)) % 360.0


def test_a_seaglider_s_file_gives_our_heading_at_the_middle_of_the_ranges() -> None:
    calibration = made(PITCH)
    random = np.random.default_rng(2)
    field = random.normal(0.0, 30_000.0, (50, 3))
    roll, pitch = random.uniform(-0.5, 0.5, (2, 50))
    vector = correct(calibration, field, np.full((50, 1), -3.0), np.arange(50.0)).vector
    expected = heading(vector, roll, pitch).magnetic
    found = seaglider_heading(seaglider(calibration, 56.0), field / 56.0, roll, pitch)
    difference = (found - expected + 180.0) % 360.0 - 180.0
    level = Rotation.from_euler("YX", np.column_stack([pitch, roll])).apply(vector)
    horizontal = np.linalg.norm(level[:, :2], axis=1)
    assert np.abs(difference * horizontal).max() < np.degrees(10.0), "hard has one decimal: 2.8 nT, rounded"


def test_what_a_seaglider_s_file_cannot_hold_costs_degrees() -> None:
    """An offset of 500 nT in y at either end, beside a horizontal field of 25,000 nT: 1.15 deg at most."""
    calibration = made(PITCH, order=1)
    coefficients = np.zeros(18)
    coefficients[9 + 7] = 500.0
    calibration = replace(
        calibration, coefficients=coefficients, boresight=Boresight((0.0, 0.0, 0.0), ((0.0,) * 3,) * 3)
    )
    (cost,) = heading_cost(calibration, dip_deg=60.0)
    assert cost.largest == pytest.approx(np.degrees(500.0 / 25_000.0), rel=0.03)
    assert cost.rms == pytest.approx(cost.largest / np.sqrt(2.0), rel=0.03)
    header, *rows = position_table(calibration, "pitchCtl").splitlines()
    assert header.startswith("pitchCtl [cm],offset_x [nT],offset_y [nT]")
    offsets = np.array([row.split(",")[:3] for row in rows], float)
    np.testing.assert_allclose(offsets[:, 2], 500.0 * (offsets[:, 0] + 3.0) / 5.0, atol=1e-6)


def test_the_seaglider_export_reports_what_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cal, file, table = (tmp_path / name for name in ("cal.json", "tcm2mat.cal", "table.csv"))
    save(made(PITCH), cal)
    assert main(["export", str(cal), "--seaglider", str(file), "--table", str(table)]) == 0
    lines = capsys.readouterr().err
    assert "cannot hold the field of pitchCtl: heading error" in lines
    assert "deg RMS" in lines
    assert len(table.read_text().splitlines()) == 12
    save(made(PITCH, turned=False), cal)
    assert main(["export", str(cal), "--seaglider", str(file)]) == 1
    assert "no boresight" in capsys.readouterr().err
