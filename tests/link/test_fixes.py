"""Test that each decoded fix is the original position, in the frame and units of its message."""

from __future__ import annotations

from math import isfinite, isnan, nan

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.linalg import solve_continuous_are

from magbridge.link.estimates import FIX_MESSAGES, WALK, Fix, Pose, widened
from magbridge.link.output import Outbox
from magbridge.mavlink import Codec, Message

NOW = 1_780_000_123_456_000
POSE = Pose(120.5, -40.25, 7.75, (0.5, -0.5, 0.5, 0.5))
FIX = Fix(NOW, 49.5123456, -57.9876543, 400.0, 120.0, 100.0, -3.5, POSE, 300)
"""North is known half as well as east, and the reset counter has gone round."""


def decoded(kind: str, fix: Fix = FIX) -> Message:
    outbox = Outbox(Codec(1, 191))
    FIX_MESSAGES[kind].send(outbox, fix, 3, 4)
    ((_, frame),) = outbox.drain()
    return Codec(255, 190).parse(frame)[0]


def test_odometry_is_what_ardupilot_takes() -> None:
    got = decoded("ODOMETRY")
    assert (got.name, got["time_usec"]) == ("ODOMETRY", NOW)
    assert (got["frame_id"], got["child_frame_id"]) == (20, 12), "LOCAL_FRD and BODY_FRD, or it is dropped"
    assert (got["x"], got["y"], got["z"]) == POSE[:3]
    assert got["q"] == POSE.attitude
    assert (got["reset_counter"], got["quality"]) == (300 % 256, 100)
    covariance = got["pose_covariance"]
    assert (covariance[0], covariance[1], covariance[6]) == (400.0, 120.0, 100.0)
    assert all(isfinite(entry) for entry in covariance), "a NaN is an internal error of the autopilot"
    assert min(covariance[k] for k in (0, 6, 11, 15, 18, 20)) > 0.0
    assert isnan(got["vx"]), "the velocity is not ours to tell"
    assert isnan(got["velocity_covariance"][0])


def test_the_sensor_is_what_px4_takes() -> None:
    got = decoded("GLOBAL_POSITION_SENSOR")
    assert (got["target_system"], got["target_component"], got["id"], got["source"]) == (3, 4, 1, 5)
    assert (got["lat"], got["lon"]) == (495_123_456, -579_876_543)
    assert (got["time_usec"], got["processing_time"]) == (NOW, 0)
    assert (got["alt"], got["eph"]) == pytest.approx((-3.5, FIX.sigma))
    assert isnan(decoded("GLOBAL_POSITION_SENSOR", replace(FIX, altitude=nan))["alt"])


def test_the_command_is_what_both_take() -> None:
    got = decoded("EXTERNAL_POSITION_ESTIMATE")
    assert (got.name, got["command"], got["frame"]) == ("COMMAND_INT", 43003, 0)
    assert (got["target_system"], got["target_component"]) == (3, 4)
    assert (got["x"], got["y"]) == (495_123_456, -579_876_543)
    assert got["param1"] == pytest.approx(NOW * 1e-6 % 1e5, abs=0.01)
    assert (got["param2"], got["param3"]) == pytest.approx((0.0, FIX.sigma))


def test_a_circle_stands_for_the_ellipse() -> None:
    """Errors drawn from the ellipse, over the sigma of the circle, have a mean square of 1."""
    drawn = np.random.default_rng(1).multivariate_normal((0, 0), [[400.0, 120.0], [120.0, 100.0]], 20_000)
    assert np.mean(np.square(drawn / FIX.sigma)) == pytest.approx(1.0, abs=0.03)


def test_across_the_antimeridian() -> None:
    there = replace(FIX, longitude=180.00001)
    assert decoded("GLOBAL_POSITION_SENSOR", there)["lon"] == -1_799_999_900
    assert decoded("EXTERNAL_POSITION_ESTIMATE", there)["y"] == -1_799_999_900


@pytest.mark.parametrize("seconds", [0.2, 1.0, 10.0])
@pytest.mark.parametrize("sigma", [5.0, 20.0, 80.0])
def test_a_filter_that_fuses_widened_fixes_claims_what_they_are_worth(sigma: float, seconds: float) -> None:
    """The filter's steady-state variance (Riccati equation) equals the variance of the original fix."""
    fix = replace(FIX, covariance_nn=sigma**2, covariance_ne=0.0, covariance_ee=sigma**2)
    sent = widened(fix, seconds)
    density = sent.covariance_nn * seconds
    wanders = np.array([[0.0, 1.0], [0.0, 0.0]])
    P = solve_continuous_are(wanders.T, np.array([[1.0], [0.0]]), np.diag([0.0, WALK]), [[density]])
    assert P[0, 0] ** 0.5 == pytest.approx(sigma, rel=1e-6)
    assert sent.covariance_ee == sent.covariance_nn


def test_what_comes_rarely_is_not_widened() -> None:
    assert widened(FIX, 3600.0) == FIX
    assert widened(FIX, float("inf")) == FIX
    ratio = widened(FIX, 0.2).covariance_nn / FIX.covariance_nn
    assert widened(FIX, 0.2).covariance_ne == pytest.approx(ratio * FIX.covariance_ne)
    assert widened(FIX, 0.2).covariance_nn == pytest.approx(5.0 * widened(FIX, 1.0).covariance_nn)
