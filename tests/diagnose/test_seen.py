"""Test the reported properties of a signal of unknown cause, and a residual far from white noise."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from demos import demo
from msgspec import structs
from posed import FIELD, T0, calibrated, right, surveyed, walk
from reported import section
from scipy.spatial.transform import Rotation

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import lagged
from magbridge.calibration.model import Calibration
from magbridge.calibration.terms import Polynomial
from magbridge.cli.diagnose import causes_of
from magbridge.diagnose.assessment import separation
from magbridge.diagnose.observed import Returns, memory, returns, seen
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import TelemetryChannel
from sitl.signals import correlated

N = 3000


@pytest.fixture(scope="module")
def flown() -> Problem:
    rng = np.random.default_rng(5)
    survey = surveyed(walk(N, rng), np.sin(np.arange(N) / 30.0))
    throttle = (rng.uniform(size=N // 20) > 0.5).repeat(20).astype(float)
    channels = survey.channels | {"throttle": TelemetryChannel(throttle, "%", ("current", "position"))}
    return pose(replace(survey, channels=channels), calibrated(np.zeros(18)))


def along(problem: Problem, axis: str) -> FloatArray:
    """Return the response (n,) of the residual to 1 nT along an axis, or along the field."""
    if axis == "field":
        return np.ones(N)
    return np.asarray(-problem.jacobian[:, 6 + "xyz".index(axis)] / problem.reference_jacobian)


def warmed(problem: Problem) -> tuple[Problem, FloatArray]:
    """Return the problem with a slow temperature as its only channel, and the temperature."""
    warmth = correlated(np.random.default_rng(10).normal(size=(N, 1)), 0.997)[:, 0]
    channel = TelemetryChannel(warmth, "degC", ("temperature",))
    return replace(problem, survey=replace(problem.survey, channels={"warmth": channel})), warmth


@pytest.mark.parametrize(("lag", "axis"), [(0.0, "z"), (30.0, "x"), (8.0, "field")])
def test_series_lag_axis_and_size_of_a_signal_are_reported(flown: Problem, lag: float, axis: str) -> None:
    survey = flown.survey
    q = lagged(survey.time, survey.channels["throttle"].values, lag)
    signal = 20.0 * q * along(flown, axis)
    noise = np.random.default_rng(6).normal(size=N)
    found = seen(flown, signal + noise)
    assert (found.channel, found.lag, found.axis) == ("throttle", lag, axis)
    assert found.size == pytest.approx(np.sqrt(np.mean(signal**2) + 1.0), rel=0.02)
    assert found.share > 0.5


def test_noise_follows_nothing(flown: Problem) -> None:
    found = seen(flown, np.random.default_rng(7).normal(size=N))
    assert found.channel is None
    assert found.share < 0.1


@pytest.mark.parametrize(("rho", "slow"), [(0.0, 1 / 64), (0.8, 9 / 64), (0.99, 0.8)])
def test_how_far_from_white_a_residual_is(flown: Problem, rho: float, slow: float) -> None:
    e = np.random.default_rng(8).normal(size=(N, 1))
    found = memory(flown, correlated(e, rho)[:, 0] if rho else e[:, 0])
    assert found.slow == pytest.approx(slow, rel=0.35)
    assert found.white == pytest.approx(found.rms * np.sqrt(1.0 - rho), rel=0.35)
    if rho:
        assert found.correlation_time == pytest.approx(-4.0 / np.log(rho), rel=0.5)


@pytest.mark.parametrize("axis", ["x", "z", "field"])
def test_the_axis_of_what_is_slow_is_reported_though_it_follows_nothing(axis: str) -> None:
    """A slow signal correlates with any slow channel, so this is not reported. Turns show the axis."""
    turned = np.random.default_rng(5).normal(size=(N // 30, 3)).repeat(30, axis=0)
    survey = surveyed(turned, np.sin(np.arange(N) / 30.0))
    hours = TelemetryChannel(
        correlated(np.random.default_rng(4).normal(size=(N, 1)), 0.997)[:, 0], "h", ("position",)
    )
    problem = pose(replace(survey, channels=survey.channels | {"hours": hours}), calibrated(np.zeros(18)))
    slow = correlated(np.random.default_rng(10).normal(size=(N, 1)), 0.997)[:, 0]
    found = seen(problem, 34.0 * slow * along(problem, axis))
    assert (found.channel, found.axis) == (None, axis)


def test_a_slow_series_that_explains_all_is_followed(flown: Problem) -> None:
    """For any slow signal the remainder is not slow."""
    problem, warmth = warmed(flown)
    signal = 20.0 * warmth + np.random.default_rng(6).normal(size=N)
    assert seen(problem, signal)[:2] == ("warmth", 0.0)


def test_a_cause_does_not_follow_a_channel_of_the_other_causes(flown: Problem) -> None:
    problem, warmth = warmed(flown)
    own = 4.0 * np.random.default_rng(6).normal(size=N)
    assert seen(problem, own + 20.0 * warmth).channel == "warmth"
    assert seen(problem, own + 20.0 * warmth, own).channel is None


def _slow_log() -> tuple[xr.Dataset, Calibration, FloatArray]:
    """Return a survey with a slow error of the reference, a calibration that states it, and the error, nT."""
    calibration, survey, _ = demo()
    noise = np.random.default_rng(9).normal(size=(survey.sizes["time"], 1))
    slow = 34.0 * correlated(noise, 0.99)[:, 0]
    loud = replace(calibration, noise=structs.replace(calibration.noise, sensor=34.0, autocorrelation=0.99))
    return survey.assign(reference_field=survey["reference_field"] + slow), loud, slow


def test_a_residual_far_from_white_is_never_nothing() -> None:
    """Noise of a long memory describes anything slow; a calibration that states it makes it no less.

    Its amplitude, its duration and the missing correlation with the log are reported.
    """
    survey, loud, slow = _slow_log()
    result = diagnose([survey], loud)
    found = result.diagnosis
    assert found.verdict == "unexplained"
    assert found.findings == ()
    facts = findings(result)
    rest, residual = facts["unexplained"], facts["assessment"]["residual"]
    assert rest["kind"] == "drift"
    assert residual["rms_nT"] == pytest.approx(np.std(slow), rel=0.1)
    assert residual["white_nT"] == pytest.approx(np.std(np.diff(slow)) / np.sqrt(2.0), rel=0.2)
    assert 60.0 < rest["correlation_time_s"] < 250.0
    assert rest["follows"]["channel"] is rest["best_channel"] is None
    assert "does not describe all" in facts["assessment"]["summary"]
    output = "\n".join(causes_of(facts))
    assert f"{residual['rms_nT']:.1f} nT RMS, lasts {rest['correlation_time_s']:.3g} s" in output
    assert 0.5 * residual["rms_nT"] < rest["rms_nT"] <= residual["rms_nT"]
    assert found.unexplained is not None
    page = section(found, "What is left")
    assert f"in all {residual['rms_nT']:.1f} nT RMS, which last" in page


# ---- Whether a track tells what changes with the place from what changes with time -----------------------


ROWS = 1350
ALONG = np.linspace(0.0, 1.0, ROWS)
UNITS = dict.fromkeys(("roll", "pitch", "heading", "latitude", "longitude"), "deg") | {"depth": "m"}
TRACKS: dict[str, FloatArray] = {
    "away": 9000.0 * ALONG,
    "there and back": 9000.0 * (1.0 - np.abs(2.0 * ALONG - 1.0)),
    "to and fro, eight times": 2000.0 * np.abs((8.0 * ALONG) % 2.0 - 1.0),
}


def flown_twice(north: FloatArray) -> Returns:
    """Return the positions (m) of a track along a meridian of four hours, there and back."""
    survey = replace(
        right(ROWS).survey,
        time=T0 + 14400.0 * ALONG,
        place=np.stack([north, 0.0 * north, 0.0 * north], axis=1),
    )
    found = returns(survey)
    assert found is not None
    return found


def test_only_returns_at_several_times_tell_place_from_time() -> None:
    away, back, fro = (flown_twice(track) for track in TRACKS.values())
    assert away.share == away.longest == 0.0
    assert "never returns" in separation(away).text
    assert back.share > 0.8
    assert back.longest == pytest.approx(14400.0, rel=0.05)
    assert (
        max(away.separable, back.separable) < 0.01
    )  # what bends about the turning point is the same on both ways
    assert "cannot be distinguished" in separation(back).text
    assert fro.separable > 0.5
    assert fro.distinguishable
    assert "can be distinguished" in separation(fro).text


@pytest.mark.parametrize("name", TRACKS)
def test_the_share_is_what_no_function_of_the_place_imitates(name: str) -> None:
    """Compare with all trends with a bend: the fraction is that of the trend that cell means explain best."""
    cell = np.floor(TRACKS[name] / 250.0)
    G = (cell[:, None] == np.unique(cell)).astype(float)
    least = np.inf
    trend, bend = ALONG - 0.5, (ALONG - 0.5) ** 2
    trend, bend = (x / np.std(x) - np.mean(x) / np.std(x) for x in (trend, bend))
    for angle in np.linspace(0.0, np.pi, 181):
        f = np.cos(angle) * trend + np.sin(angle) * bend
        residual = f - G @ np.linalg.lstsq(G, f, rcond=None)[0]
        least = min(least, float(np.var(residual) / np.var(f)))
    assert flown_twice(TRACKS[name]).separable == pytest.approx(least, abs=2e-3)


def logged(hidden: str, track: str) -> xr.Dataset:
    """Return six hours of a vehicle that dives along a track, with one effect hidden in the log."""
    rng = np.random.default_rng(1)
    north, hours = TRACKS[track], 6.0 * ALONG
    pitch = 0.4 * np.sign(np.sin(np.arange(ROWS) / 13.0)) + 0.1 * rng.normal(size=ROWS)
    heading = np.pi * (np.gradient(north) < 0.0) + 0.3 * rng.normal(size=ROWS)
    roll = 0.2 * rng.normal(size=ROWS)
    u = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=1)).inv().apply([0.35, 0.05, 0.935])
    noise = rng.normal(size=(ROWS, 3))
    reference, offset = np.full(ROWS, FIELD), np.zeros((ROWS, 3))
    if hidden == "map_error":
        reference += 3.0 * (np.sin(north / 700.0 + 2.0) + np.cos(north / 310.0))
    elif hidden == "diurnal_variation":
        reference += 12.0 * np.cos(2.0 * np.pi * hours / 24.0 - 2.0)
        noise = correlated(noise, 0.9)
    else:
        offset = np.outer(ALONG > 0.6, [0.6, 0.2, 0.77])
    field = FIELD * u / np.linalg.norm(u[0]) + offset + noise
    angles = np.degrees([roll, pitch, heading % (2.0 * np.pi)])
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), field.T, strict=True))
    columns |= dict(zip(("roll", "pitch", "heading"), angles, strict=True))
    columns |= {
        "reference_field": reference, "latitude": 45.0 + north / 111_200.0, "longitude": np.full(ROWS, -60.0),
        "depth": 40.0 - 35.0 * np.cos(np.arange(ROWS) / 13.0),
    }  # fmt: skip
    ds = xr.Dataset({k: ("time", v) for k, v in columns.items()}, {"time": T0 + 3600.0 * hours})
    for name, column in ds.data_vars.items():
        column.attrs["units"] = UNITS.get(str(name), "nT")
    return ds.assign_attrs(source="made")


@pytest.mark.parametrize(
    ("hidden", "track"),
    [
        ("map_error", "to and fro, eight times"),
        ("diurnal_variation", "away"),
        ("offset_step", "there and back"),
    ],
)
def test_one_hidden_cause_gets_one_name_and_alternatives_where_the_track_cannot_decide(
    hidden: str, track: str
) -> None:
    """A small step, a map's error, and a daily variation under autoregressive noise."""
    known = replace(calibrated(np.zeros(9), 1e-2), parameters=(), terms=(Polynomial(exponents=((),)),))
    found = diagnose([logged(hidden, track)], known)
    facts = findings(found)
    (one,) = facts["findings"]
    others = [other["cause"] for other in one["alternatives"]] if track == "away" else []
    assert hidden in [one["cause"], *others]
    output = facts["assessment"]["spatial_temporal"]
    assert output["distinguishable"] == (track == "to and fro, eight times")
    codes = [one["code"] for one in facts["assessment"]["reasons_against"]]
    assert ("spatial_temporal" in codes) == (hidden == "diurnal_variation" and track == "away")
    assert output["text"] in section(found.diagnosis, "What this log could have shown")
