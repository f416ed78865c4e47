"""Test each effect's regressors against its equation, on short logs with a known result."""

from math import exp, nan
from pathlib import Path

import numpy as np
import pytest
from gliders import Gliders
from posed import EFFECTS

from magbridge.calibration.correct import correct
from magbridge.calibration.effects import (
    ChannelEffect,
    ClockEffect,
    LegendreEffect,
    PlayEffect,
    PowersEffect,
    RateEffect,
    ResponseEffect,
    SourcesEffect,
    TimeEffect,
)
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.pose import read_vehicle
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import MAX_ORDER, Effect, LogSeries, Polynomial
from magbridge.errors import CalibrationError, ConfigError
from magbridge.estimation.residual import symmetric

START = 1.7e9
LAG = 100.0
P = Parameter("p", "in", -1.0, 1.0, 0.0, 1.0)


def with_effect(effect: Effect, c: np.ndarray | None = None, of_p: np.ndarray | None = None) -> Calibration:
    """Return a calibration with the term ``(a, T) = of_p p`` (nT) and the effect of coefficients c."""
    coefficients = np.zeros(18 + effect.size)
    coefficients[9:18] = 0.0 if of_p is None else of_p
    coefficients[18:] = 0.0 if c is None else c
    return Calibration(
        parameters=(P,), terms=(Polynomial(exponents=((0,), (1,))),), coefficients=coefficients,
        covariance=np.eye(len(coefficients)), noise=Noise(1.0), reference=Reference(5e4), effects=(effect,),
    )  # fmt: skip


def stepped(
    effect: Effect, time: np.ndarray, values: np.ndarray | None = None, field: np.ndarray | None = None
) -> np.ndarray:
    """Return the (n, r) regressors of an effect whose channel, or else whose position, has `values`."""
    n, cal = len(time), with_effect(effect, of_p=np.arange(1.0, 10.0))
    channels = {name: np.zeros(n) for name in cal.channels}
    if values is not None:
        channels[cal.channels[-1]] = values
    field = np.full((n, 3), 3e4) if field is None else field
    series = LogSeries(START + time, field, channels, cal.kernel)
    one_by_one = Effect.batch(effect, series)
    np.testing.assert_allclose(effect.batch(series), one_by_one, rtol=1e-6, atol=1e-9)
    return one_by_one.T


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda one: one.kind)
def test_an_effect_has_one_physics_in_two_forms(effect: Effect) -> None:
    """The forms for a sample and for a log agree, with jitter, gaps, unknown values and missing readings."""
    rng, n = np.random.default_rng(3), 300
    time = np.cumsum(rng.choice([4.0, 4.1, 37.0, 400.0], n, p=[0.6, 0.3, 0.09, 0.01]))
    values = np.clip(0.15 * rng.normal(size=n).cumsum(), -1.0, 1.0)
    values[rng.random(n) < 0.1] = values[:3] = nan
    field = rng.uniform(-6e4, 6e4, (n, 3))
    field[rng.random(n) < 0.05, 1] = nan
    found = stepped(effect, time, values, field)
    assert found.shape == (n, effect.columns(5e4).shape[1])
    assert np.ptp(found[np.isfinite(found).all(axis=1)], axis=0).all()


def test_a_lag_approaches_a_new_temperature_as_heat_stores_do() -> None:
    """A first-order lag gives 1 - exp(-t/L); two of half the lag in series 1 - (1 + 2t/L) exp(-2t/L)."""
    t = np.arange(0.0, 600.0, 5.0)
    warm = np.where(t > 0.0, 7.0, 5.0)
    one, two, none = (
        stepped(ChannelEffect(cause="", channel="warm", origin=3.0, lag=lag, stages=k), t, warm)[:, 0]
        for lag, k in ((LAG, 1), (LAG, 2), (0.0, 1))
    )
    np.testing.assert_allclose(one, 4.0 - 2.0 * np.exp(-t / LAG))
    np.testing.assert_array_equal(none, warm - 3.0)
    late = 4.0 - 2.0 * (1.0 + 2.0 * t / LAG) * np.exp(-2.0 * t / LAG)
    np.testing.assert_allclose(two, late, atol=0.06)  # a store holds still within a sample: 2.5 s of LAG


def test_a_lagged_channel_holds_while_it_is_unknown() -> None:
    t = np.array([0.0, 10.0, 20.0, 30.0])
    effect = ChannelEffect(cause="", channel="warm", lag=LAG)
    got = stepped(effect, t, np.array([1.0, nan, nan, 3.0]))[:, 0]
    np.testing.assert_allclose(got, [1.0, 1.0, 1.0, 3.0 - 2.0 * exp(-0.3)])


def test_powers_and_sources_of_a_mass() -> None:
    p = np.array([-2.0, 1.0, nan, 4.0])
    held = np.array([-2.0, 1.0, 1.0, 4.0])
    got = stepped(PowersEffect(cause="", channel="fin", centre=1.0, scale=3.0, order=3), np.arange(4.0), p)
    np.testing.assert_allclose(got, ((held - 1.0) / 3.0)[:, None] ** [1, 2, 3])
    row = SourcesEffect(cause="", channel="fin", centre=-2.0, scale=1.5, apart=2.0, count=3)
    got = stepped(row, np.arange(4.0), p)
    distance = np.hypot(1.5, held[:, None] - (-2.0 + 3.0 * np.arange(3.0)))
    np.testing.assert_allclose(got, (1.5 / distance) ** 3)


def test_legendre_polynomials_of_positions() -> None:
    p = np.array([-0.5, 0.0, 2.0])
    got = stepped(LegendreEffect(cause="", exponents=(3,)), np.arange(3.0), p)
    np.testing.assert_allclose(got[:, 0], (5.0 * p**3 - 3.0 * p) / 2.0)
    for exponents in ((-1,), (MAX_ORDER + 1,), (1, 1), ()):
        with pytest.raises(CalibrationError, match="legendre: expected"):
            with_effect(LegendreEffect(cause="", exponents=exponents))


SWEEP = np.concatenate(
    [np.linspace(0.0, 1.0, 51), np.linspace(1.0, -1.0, 101)[1:], np.linspace(-1.0, 1.0, 101)[1:]]
)


def test_backlash_is_a_loop_of_its_width() -> None:
    """The load trails the drive by half the width; a motion within the play does not move it."""
    slack = PlayEffect(cause="", channel="fin", width=0.4, centre=0.0, scale=1e6)
    t = np.arange(float(len(SWEEP)))
    behind = stepped(slack, t, SWEEP)[:, 0]
    assert behind[0] == 0.0
    moved = np.diff(SWEEP, prepend=0.0)
    engaged = np.abs(SWEEP - np.where(moved > 0, np.where(t < 51, 0.0, -1.0), 1.0)) >= 0.4
    engaged |= (t < 51) & (SWEEP >= 0.2)
    np.testing.assert_allclose(behind[engaged], -0.5 * np.sign(moved[engaged]), atol=1e-6)
    small = stepped(slack, np.arange(5.0), np.array([0.0, 0.1, -0.1, nan, 0.15]))[:, 0]
    np.testing.assert_allclose(small, [0.0, -0.25, 0.25, 0.25, -0.375], atol=1e-6)


def test_steel_next_to_the_path_makes_a_loop_that_closes_farther_away() -> None:
    near = PlayEffect(cause="", channel="fin", width=0.1, centre=0.3, scale=0.1)
    t = np.arange(float(len(SWEEP)))
    loop = np.abs(stepped(near, t, SWEEP)[:, 0])
    passing = np.abs(SWEEP - 0.3) < 0.02
    assert loop[passing].min() > 0.4  # nearly the half width that it has for backlash
    assert loop[np.abs(SWEEP - 0.3) > 0.6].max() < 1e-4
    older = stepped(PlayEffect(cause="", channel="fin", width=0.1, centre=0.5, scale=2.0, order=2), t, SWEEP)
    y, p = (SWEEP[40] - 0.05 - 0.5) / 2.0, (SWEEP[40] - 0.5) / 2.0
    np.testing.assert_allclose(older[40], [y - p, y**2 - p**2], atol=1e-12)


def test_functions_of_time() -> None:
    t = np.array([-20.0, -5.0, 0.0, 2.5, 40.0])
    step, drift, tone = (
        stepped(TimeEffect(cause="", shape=shape, start=START, period=10.0, order=2), t)
        for shape in ("step", "drift", "tone")
    )
    np.testing.assert_array_equal(step[:, 0], [0, 0, 1, 1, 1])
    np.testing.assert_allclose(drift, [[-1.0, 1.0], [-0.5, 0.25], [0.0, 0.0], [0.25, 0.0625], [1.0, 1.0]])
    np.testing.assert_allclose(tone, [[1, 0], [-1, 0], [1, 0], [0, 1], [1, 0]], atol=1e-6)


def test_the_rate_of_a_steadily_accelerating_field_is_exact() -> None:
    """The rate is from three samples at any interval; it skips a missing one and restarts after a gap."""
    t = np.array([0.0, 4.0, 7.0, 12.0, 16.0, 16.5, 90.0, 94.0, 98.0])
    a, b = np.array([300.0, -200.0, 50.0]), np.array([2.0, 1.0, -3.0])
    field = 2e4 + np.outer(t, a) + np.outer(t**2, b)
    field[3, 1] = nan
    rates = stepped(RateEffect(cause="", on="skew"), t, field=field)
    exact = a + 2.0 * np.outer(t, b)
    known = [2, 4, 5, 8]
    np.testing.assert_allclose(rates[known], exact[known], rtol=1e-6)
    np.testing.assert_array_equal(rates[[0, 3, 6]], 0.0)


@pytest.mark.parametrize("on", ["skew", "eddy"])
def test_a_rate_moves_the_channels_that_it_names(on: str) -> None:
    size, t = {"skew": 3, "eddy": 6}[on], np.arange(4.0)
    ramp = np.outer(t, [100.0, 10.0, 1.0])
    rates = {"skew": np.diag([100.0, 10.0, 1.0]), "eddy": np.zeros((6, 3))}[on]
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))):
        if on == "eddy":
            rates[k, i] = 10.0 ** (2 - j)
    for k in range(size):
        cal = with_effect(RateEffect(cause="", on=on), 0.5 * np.eye(size)[k])  # type: ignore[arg-type]
        shift = ramp - correct(cal, ramp, np.zeros((4, 1)), START + t).vector
        np.testing.assert_allclose(shift[3], 0.5 * rates[k], atol=1e-9)


def test_a_response_bends_each_channel_by_itself_or_one_at_a_knee() -> None:
    H = np.array([[-3e4, 1e4, 2e4], [5e4, -2e4, 4e4]])
    cubic = ResponseEffect(cause="", unit=1e4, power=3)
    np.testing.assert_allclose(stepped(cubic, np.arange(2.0), field=H), (H / 1e4) ** 3)
    z = np.array([-3e4, -1e4, 1e4, 2e4, 3e4])
    H = np.column_stack([z, z, z])
    for sign, over in ((1.0, np.maximum(z - 2e4, 0.0)), (-1.0, np.minimum(z + 2e4, 0.0))):
        knee = ResponseEffect(cause="", unit=1e4, axis=2, knee=sign * 2e4)
        cal = with_effect(knee, np.array([7.0, 100.0]))
        shift = H - correct(cal, H, np.zeros((5, 1)), START + np.arange(5.0)).vector
        expected = -7.0 * sign * (sign * z >= 2e4) - 100.0 * over / 1e4
        np.testing.assert_allclose(shift, np.outer(expected, [0.0, 0.0, 1.0]), atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_late_clock_is_set_right_while_the_mass_moves_steadily(sign: float) -> None:
    t = np.array([0.0, 4.0, 8.0, 11.0, 300.0, 304.0])
    delay, speed, H = 1.7, 0.05, np.array([2e4, -1e4, 4e4])
    of_p = np.array([50.0, -20.0, 30.0, 10.0, 0.0, -40.0, 900.0, -400.0, 2000.0])
    a, T = symmetric(of_p[None])[0], of_p[6:]
    cal = with_effect(ClockEffect(sign=sign), np.array([delay]), of_p)
    position = speed * t
    reads = np.array([np.linalg.solve(np.eye(3) + a / 5e4 * p, H) + T * p for p in position])
    logged = (position - sign * speed * delay)[:, None]
    vector = correct(cal, reads, logged, START + t).vector
    seen = [1, 2, 3, 5]
    np.testing.assert_allclose(vector[seen], np.broadcast_to(H, (4, 3)), atol=1e-6)
    # no rate is known at the first sample, nor after a gap
    assert np.abs(vector[[0, 4]] - H).max() > 0.9 * speed * delay * np.abs(T).max()


def test_a_term_that_lacks_a_method_cannot_be_made() -> None:
    class Half(Effect, frozen=True, kw_only=True):
        kind = "half"

    with pytest.raises(TypeError, match=r"abstract methods? .*begin"):
        Half()  # type: ignore[abstract]


# ---- The vehicle file that says where moving dipoles are ---------------------------------------------------


def test_vehicle_toml(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text("[mass.battpos]\nat = [-0.45, 0.0, 0.05]\nat_sigma = 0.05\ntravel = [0.0254, 0.0, 0.0]\n")
    assert read_vehicle(path)["battpos"].at == (-0.45, 0.0, 0.05)
    for text, match in (
        ("[mass.battpos]\nat = [1, 2]\ntravel = [0, 0, 0]", "mass.*at"),
        ("[mass.battpos]\nat = [1.0, 0.0, 0.0]\ntravel = [0.0, 0.0, 0.0]\nweight = 3", "weight"),
        ("[mass", "not TOML"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=match):
            read_vehicle(path)


def test_a_mass_that_no_parameter_moves_is_refused(glider: Gliders) -> None:
    vehicle = {"fin": {"at": [1.0, 0.0, 0.0], "travel": [0.0, 0.0, 0.1]}}
    with pytest.raises(CalibrationError, match="mass 'fin'"):
        fit(glider(0, 2).runs, vehicle=vehicle)
