"""Undo the anti-alias filter sample after sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from magbridge.calibration.file import decode_calibration, encode_calibration
from magbridge.calibration.model import CalibratedSensor, Noise, identity
from magbridge.config import Align
from magbridge.correction import Correction
from magbridge.errors import CalibrationError
from magbridge.filter_lag import LagCorrection
from magbridge.records import Reading

CUTOFF_HZ, HORIZONTAL_NT = 0.33, 18_000.0


def turning(
    step_s: float, noise_nt: float, rate_deg_s: float = 1.6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (s), the true and the filtered field (n, 3), nT, of a vehicle that turns."""
    fine, tau = 0.01, 1.0 / (2.0 * np.pi * CUTOFF_HZ)
    time = np.arange(0.0, max(200.0, 100.0 * step_s), fine)
    angle = np.radians(1.6) * time
    true = np.stack(
        [HORIZONTAL_NT * np.cos(angle), HORIZONTAL_NT * np.sin(angle), np.full(len(time), 48_000.0)], axis=1
    )
    share = 1.0 - np.exp(-fine / tau)
    slow = lfilter([share], [1.0, share - 1.0], true - true[0], axis=0) + true[0]
    rows = slice(round(20.0 / fine), None, round(step_s / fine))
    noise = np.random.default_rng(1).normal(0.0, noise_nt, slow[rows].shape)
    return time[rows], true[rows], slow[rows] + noise


def heading_error(field: np.ndarray, true: np.ndarray) -> float:
    """Return the RMS error of the direction of the horizontal field, deg."""
    difference = np.arctan2(field[:, 1], field[:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    return float(np.degrees(np.sqrt(np.mean((np.angle(np.exp(1j * difference))) ** 2))))


@pytest.mark.parametrize("step_s", [4.0, 1.0, 0.1, 0.02])
def test_the_lag_of_a_turn_is_undone_and_the_length_stays(step_s: float) -> None:
    time, true, measured = turning(step_s, 1.0)
    lag = LagCorrection(CUTOFF_HZ)
    found, variance = [], []
    for seconds, field in zip(time.tolist(), measured.tolist(), strict=True):
        found.append(lag.undo(round(seconds * 1e6), tuple(field)))
        variance.append(lag.variance)
    assert heading_error(measured, true) > 0.7
    assert heading_error(np.array(found)[3:], true[3:]) < 0.1
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(measured, axis=1), rtol=1e-12)
    assert np.sqrt(np.mean(variance[3:])) < 0.002 * HORIZONTAL_NT


def test_an_abrupt_change_is_no_turn_but_makes_the_vector_uncertain() -> None:
    """Eight time constants after a step nothing of it is left in the filter; the slope says otherwise."""
    lag = LagCorrection(CUTOFF_HZ)
    before, after = (20_000.0, 0.0, 40_000.0), (0.0, 20_000.0, 40_000.0)
    for k, field in enumerate([before] * 5 + [after] * 5):
        assert lag.undo(4_000_000 * k, field) == pytest.approx(field, abs=1.0)
        assert (lag.variance > 1000.0**2) == (k in (5, 6))


def test_a_gap_and_a_missing_number_are_no_slope() -> None:
    lag = LagCorrection(CUTOFF_HZ)
    assert lag.undo(0, (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert np.isnan(lag.undo(1_000_000, (np.nan, 2.0, 3.0))[0])
    lag.undo(1_000_000, (2.0, 2.0, 3.0))
    assert lag.undo(60_000_000, (500.0, 2.0, 3.0)) == (500.0, 2.0, 3.0)


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_a_calibration_that_names_the_filter_corrects_without_lag(delay_s: float) -> None:
    """What ``align.filter_delay`` corrects in the time of a sample is not undone once more."""
    sensor = CalibratedSensor("ascii", filter_cutoff=CUTOFF_HZ)
    calibration = replace(identity(), sensor=sensor, method="made for a test", noise=Noise(1.0))
    kept = decode_calibration(encode_calibration(calibration))
    assert kept.sensor == calibration.sensor
    time, true, measured = turning(0.5, 0.0)
    correction = Correction(kept, Align(filter_delay=delay_s))
    field = []
    for seconds, row in zip(time.tolist(), measured.tolist(), strict=True):
        field.append(correction.reading(Reading(tuple(row)), round(seconds * 1e6))[1].field)
    late = np.radians(1.6) * delay_s
    turn = np.array([[np.cos(late), np.sin(late), 0.0], [-np.sin(late), np.cos(late), 0.0], [0.0, 0.0, 1.0]])
    assert heading_error(np.array(field)[6:], true[6:] @ turn.T) < 0.05


@pytest.mark.parametrize("cutoff", [-1.0, 1e9])
def test_an_impossible_cutoff_is_refused(cutoff: float) -> None:
    calibration = replace(identity(), sensor=CalibratedSensor("ascii", filter_cutoff=cutoff))
    with pytest.raises(CalibrationError, match="filter_cutoff"):
        decode_calibration(encode_calibration(calibration))
