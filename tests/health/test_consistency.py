"""Test that attitude-dependent errors widen sigma, and that a fast flight over an anomaly does not."""

from functools import partial
from math import nan

import numpy as np
import pytest

from magbridge.arrays import FloatArray
from magbridge.calibration.model import Noise
from magbridge.estimation.residual import rms
from magbridge.health import HealthMonitor
from magbridge.health.consistency import Sensitivity
from magbridge.records import Quality

FIELD = 52_000.0
IMPLAUSIBLE = int(Quality.IMPLAUSIBLE)


def glide(seed: int, n: int = 2700) -> tuple[FloatArray, FloatArray]:
    """Return directions (n, 3) of the field in dives and turns, and a crustal anomaly (n,), every 4 s."""
    rng = np.random.default_rng(seed)
    time = 4.0 * np.arange(n)
    pitch = np.where((time // 840.0) % 2 == 0.0, -0.42, 0.42)
    heading = np.radians(110.0) * (time // 2400.0)
    for angle in (pitch, heading):
        angle[:] = np.convolve(np.pad(angle, 10, "edge"), np.ones(11) / 11, "same")[10:-10]
    pitch = pitch + np.radians(rng.normal(0.0, 0.6, n))
    h, v = 0.35, 0.94
    u = np.stack(
        [
            np.cos(pitch) * np.cos(heading) * h - np.sin(pitch) * v,
            -np.sin(heading) * h,
            np.sin(pitch) * np.cos(heading) * h + np.cos(pitch) * v,
        ],
        axis=1,
    )
    way = 0.35 * time
    crust = 25.0 * np.sin(way / 230.0 + seed) + 15.0 * np.sin(way / 140.0)
    return u, crust


def monitor(
    total: FloatArray,
    u: FloatArray,
    warmth: FloatArray,
    *,
    speed: float,
    step: float,
    own: FloatArray | None = None,
    error_effects: FloatArray | None = None,
    mass_changes: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Return sigma (n,), flags (n,) and messages; each sample's own sigma (n,) is 1.5 nT by default.

    `error_effects` (n, r) are the effects of the calibration's independent errors, nT, `mass_changes`
    (n, m) those of moving each mass by 3 % of its range.
    """
    error_effects = np.zeros((len(total), 0)) if error_effects is None else error_effects
    own = np.full(len(total), 1.5) if own is None else own
    masses = np.zeros((len(total), 0)) if mass_changes is None else mass_changes
    health, rng = HealthMonitor(Noise(1.0), masses=masses.shape[1]), np.random.default_rng(9)
    sigma, flags = np.empty((2, len(total)))
    for k, F in enumerate(total.tolist()):
        time_us = round(1e6 * step * (k + 1))
        health.set_position(time_us, 47.0 + speed * step * k / 111_200.0, -59.0)
        field = tuple((F * u[k]).tolist())
        raw = tuple((F * u[k] + rng.normal(0.0, 0.1, 3)).tolist())
        fields = F, float(own[k])
        effects = partial(Sensitivity, masses[k].tolist(), error_effects[k])
        more = health.check(time_us, raw, field, fields, 0, (FIELD, 145.0), float(warmth[k]), 0.0, effects)
        sigma[k], flags[k] = (own[k] ** 2 + more) ** 0.5, health.flags
    return sigma, flags, health.messages


@pytest.mark.parametrize("fault", ["none", "small", "offset", "gain", "temperature", "drift"])
def test_error_that_follows_the_attitude_widens_sigma(fault: str) -> None:
    u, crust = glide(3)
    time = 4.0 * np.arange(len(u))
    warmth = 10.0 + 4.0 * np.sin(time / 700.0)
    amount = {
        "none": np.zeros(len(u)),
        "small": 1.5 * np.ones(len(u)),  # less than the sigma that the samples have
        "offset": 15.0 * np.ones(len(u)),
        "temperature": 3.0 * (warmth - 10.0),
        "drift": 20.0 * time / 3600.0,
    }
    late = time > 1500.0
    error = 60.0 * u[:, 0] ** 2 * late if fault == "gain" else amount.get(fault, crust) * u[:, 0] * late
    noise = np.random.default_rng(7).normal(0.0, 1.0, len(u))
    sigma, flags, messages = monitor(FIELD + crust + error + noise, u, warmth, speed=0.35, step=4.0)
    if fault in {"none", "small"}:
        assert not flags.any()
        assert (sigma == 1.5).all()
        assert messages == []
        return
    plain = (flags == 0) & (time > 5000.0)
    assert np.count_nonzero((np.abs(error + noise) > 3.0 * sigma) & plain) < 0.02 * len(u)
    assert messages


@pytest.mark.parametrize("wrong", [0.0, 0.06])
def test_wrong_telemetry_of_a_mass_is_named_and_widens_sigma(wrong: float) -> None:
    """The telemetry of one of two masses is wrong by 6 % of its range, twice the prior's 1-sigma."""
    u, crust = glide(5)
    k = np.arange(len(u))
    # of effects of second order, because one of first order looks like an offset
    changes = np.stack([40.0 * u[:, 0] * np.cos(k / 37.0), 15.0 * u[:, 2] * np.sin(k / 40.0)], axis=1)
    error = wrong / 0.03 * changes[:, 0] * (k > 300)
    noise = np.random.default_rng(7).normal(0.0, 1.0, len(u))
    warmth = np.full(len(u), nan)
    total = FIELD + crust + error + noise
    sigma, flags, messages = monitor(total, u, warmth, speed=0.35, step=4.0, mass_changes=changes)
    if not wrong:
        assert not flags.any()
        assert (sigma == 1.5).all()
        assert messages == []
        return
    assert any("telemetry of a mass wrong" in line for line in messages)
    late = (flags == 0) & (k > 1000)
    assert np.count_nonzero(np.abs(error + noise)[late] > 3.0 * sigma[late]) < 0.02 * len(u)


@pytest.mark.parametrize("seed", range(4))
def test_error_that_the_calibration_states_hardly_widens_sigma(seed: int) -> None:
    """On the way up sigma is 1.9 nT with an error of 1.5, on the way down it is that of the noise."""
    u, crust = glide(seed)
    rising = u[:, 0] > 0.3
    noise = np.random.default_rng(seed + 100).normal(0.0, 1.0, len(u))
    own = np.where(rising, 1.9, 1.0)
    warmth = np.full(len(u), nan)
    total = FIELD + 0.2 * crust + 1.5 * rising + noise
    effects = np.sqrt(own**2 - 1.0)[:, None]
    sigma, flags, _ = monitor(total, u, warmth, speed=0.35, step=4.0, own=own, error_effects=effects)
    assert not flags.any()
    assert rms(sigma) < 1.1 * rms(own)


@pytest.mark.parametrize("seed", range(2))
def test_plane_over_a_steep_anomaly_is_not_flagged(seed: int) -> None:
    """22 m/s over 120 nT within a kilometre, at 5 Hz, with turns: up to 17 nT/s."""
    rng = np.random.default_rng(seed)
    time = 0.2 * np.arange(4000)
    crust = 120.0 * np.sin(2.0 * np.pi * 22.0 * time / 1000.0 + seed) + 60.0 * np.sin(0.2 * time)
    heading = np.cumsum(0.2 * 0.17 * ((time % 90.0) < 9.0))
    heading += np.radians(np.convolve(rng.normal(size=4000), np.ones(10) / 10, "same"))
    u = np.stack([0.5 * np.cos(heading), -0.5 * np.sin(heading), np.full(4000, 0.87)], axis=1)
    total = FIELD + crust + rng.normal(0.0, 0.7, 4000)
    sigma, flags, _ = monitor(total, u, np.full(4000, nan), speed=22.0, step=0.2)
    assert np.mean(flags != 0) <= 0.003
    assert np.mean(sigma > 3.0) < 0.05


@pytest.mark.parametrize("speed", [0.3, 3.0, 25.0, 60.0])
@pytest.mark.parametrize("seed", range(2))
def test_vehicle_that_takes_off_is_not_a_fault(speed: float, seed: int) -> None:
    """The vehicle stands for 30 s, then flies and turns over waves of 120 nT RMS and 1 km length."""
    rng = np.random.default_rng(seed)
    n, step = 4000, 0.1
    time = step * np.arange(n)
    heading = np.cumsum(step * 0.15 * ((time % 60.0 > 50.0) & (time > 40.0)))
    metres = step * speed * np.clip((time - 30.0) / 5.0, 0.0, 1.0)
    north, east = np.cumsum(metres * np.cos(heading)), np.cumsum(metres * np.sin(heading))
    waves = rng.normal(0.0, 1e-3, (100, 2))
    phases = waves @ np.stack([north, east]) + rng.uniform(0.0, 2.0 * np.pi, (100, 1))
    total = FIELD + 120.0 * 0.02**0.5 * np.cos(phases).sum(axis=0) + rng.normal(0.0, 1.0, n)
    pitch = 0.2 * np.clip((time - 30.0) / 3.0, 0.0, 1.0) * (time < 90.0)
    u = np.stack([0.4 * np.cos(heading) - 0.9 * pitch, -0.4 * np.sin(heading), 0.9 + 0.4 * pitch], axis=1)
    u /= np.linalg.norm(u, axis=1)[:, None]
    health, more, flags = HealthMonitor(Noise(1.0)), [], []
    for k in range(n):
        time_us = 1_000_000_000 + round(1e6 * time[k])
        health.set_position(time_us, 49.5 + north[k] / 111_200.0, -57.9 + east[k] / 72_200.0)
        field = tuple((total[k] * u[k]).tolist())
        raw = tuple((total[k] * u[k] + rng.normal(0.0, 0.1, 3)).tolist())
        one = float(total[k]), 1.0
        more.append(health.check(time_us, raw, field, one, 0, (FIELD, 145.0), nan, 0.0, Sensitivity))
        flags.append(health.flags)
    assert np.mean(np.array(flags) != 0) < 0.003
    assert np.mean(np.array(more) > 8.0) < 0.05


def test_reading_that_repeats_on_all_axes_is_flagged_after_a_few() -> None:
    u, crust = glide(1, 900)
    raw = np.round((FIELD + crust)[:, None] * u + np.random.default_rng(2).normal(0.0, 1.0, u.shape), 3)
    raw[600:] = raw[600]
    health = HealthMonitor(Noise(1.0))
    flags = []
    for k, field in enumerate(raw.tolist()):
        total = float(np.linalg.norm(field))
        one = (field[0], field[1], field[2])
        health.check(4_000_000 * (k + 1), one, one, (total, 1.5), 0, (FIELD, 145.0), nan, 0.0, Sensitivity)
        flags.append(health.flags)
    assert not any(flags[:600])
    assert all(flags[606:])
    assert "all axes repeat one reading" in health.messages[0]


def test_motion_that_is_reported_late_is_not_a_jump() -> None:
    """At 10 Hz a mass moves for a second before its report: nothing is flagged after the motion."""
    health = HealthMonitor(Noise(1.0))
    rng = np.random.default_rng(5)
    moving, flags = int(Quality.MOVING), []
    for k in range(3000):
        time_us = 100_000 * (k + 1)
        off = 8.0 * min(max(k - 1000, 0), 10) if k < 1200 else 0.0  # 80 nT within a second, then reported
        quality = moving if 1010 <= k < 1200 else 0
        if k == 1010:
            health.begin_motion(time_us - 1_000_000)
        total = FIELD + off + float(rng.normal())
        field = (0.3 * total, 0.2 * total, 0.93 * total)
        health.check(time_us, field, field, (total, 1.5), quality, (FIELD, 145.0), nan, 0.0, Sensitivity)
        flags.append(health.flags)
    assert not any(flags[1200:])


def test_step_of_the_reference_widens_nothing() -> None:
    """Another sheet of a map: the total field has no step."""
    u, crust = glide(3)
    total = FIELD + crust + np.random.default_rng(7).normal(0.0, 1.0, len(u))
    health, more = HealthMonitor(Noise(1.0)), []
    for k, F in enumerate(total.tolist()):
        health.set_position(4_000_000 * (k + 1), 47.0 + 0.35 * 4.0 * k / 111_200.0, -59.0)
        field = tuple((F * u[k]).tolist())
        main = FIELD + 60.0 * (k > 1000), 145.0
        more.append(health.check(4_000_000 * (k + 1), field, field, (F, 1.5), 0, main, nan, 0.0, Sensitivity))
    assert max(more) < 1.0
