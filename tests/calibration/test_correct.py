"""Test the correction against a naive implementation, and live against batch."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from magbridge.calibration.correct import Corrector, correct, forward, vector_covariance
from magbridge.calibration.effects import ChannelEffect
from magbridge.calibration.kernel import TABLE_SUMS
from magbridge.calibration.model import Boresight, Calibration, Noise, Parameter, Reference
from magbridge.calibration.terms import Effect, Polynomial, full_order
from magbridge.errors import CalibrationError
from magbridge.records import Quality

F_0 = 50_000.0


def turned(rotation: tuple[float, float, float], covariance: np.ndarray) -> Boresight:
    return msgspec.convert({"rotation": rotation, "covariance": covariance.tolist()}, Boresight)


def random_calibration(
    seed: int, k: int = 2, order: int = 3, *, boresight: bool = False, extra: bool = False
) -> Calibration:
    rng = np.random.default_rng(seed)
    terms = (Polynomial(exponents=full_order(k, order)),)
    effects: tuple[Effect, ...] = ()
    if extra:
        effects = (
            ChannelEffect(cause="temperature_offset", channel="sensor_temperature", lag=60.0, stages=2),
        )
    size = sum(term.size for term in (*terms, *effects))
    root = rng.normal(size=(size, size))
    return Calibration(
        parameters=tuple(Parameter(f"p{i}", "in", -1.0, 1.2, 0.1, 1.1) for i in range(k)),
        terms=terms,
        effects=effects,
        coefficients=rng.normal(size=size) * 300.0 * (np.arange(size) < size - 3 * extra),
        covariance=root @ root.T,
        noise=Noise(1.5),
        reference=Reference(F_0),
        boresight=turned((0.01, -0.02, 0.3), np.eye(3) * 1e-5) if boresight else None,
        method="auto",
    )


def random_samples(seed: int, n: int, channels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    field = rng.normal(size=(n, 3))
    field *= F_0 / np.linalg.norm(field, axis=1)[:, None]
    return field, rng.uniform(-1.2, 1.4, size=(n, channels)), np.arange(n) * 4.0


def naive(cal: Calibration, c: np.ndarray, h: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return b = A (h - T) of one sample, straight from the equation, for polynomials only."""
    x = np.array([(v - par.centre) / par.scale for v, par in zip(p, cal.parameters, strict=True)])
    (polynomial,) = cal.terms
    monomials = np.array([np.prod(x ** np.array(e)) for e in polynomial.exponents])
    theta = monomials @ c.reshape(-1, 9)
    a = theta[:6] / F_0
    A = np.eye(3) + np.array([[a[0], a[3], a[4]], [a[3], a[1], a[5]], [a[4], a[5], a[2]]])
    return A @ (h - theta[6:])


@pytest.mark.parametrize(("k", "order"), [(0, 0), (1, 3), (2, 3), (3, 2), (2, 5)])
def test_agrees_with_the_equation_as_it_stands(k: int, order: int) -> None:
    cal = random_calibration(1, k, order)
    field, positions, time = random_samples(2, 5, k)
    got = correct(cal, field, positions, time)
    for i in range(5):
        b = naive(cal, cal.coefficients, field[i], positions[i])
        np.testing.assert_allclose(got.vector[i], b, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(got.total[i], np.linalg.norm(b), rtol=1e-11)


def test_sigma_is_the_covariance_carried_through() -> None:
    cal = random_calibration(3)
    field, positions, time = random_samples(4, 4, 2)
    got = correct(cal, field, positions, time)
    steps = 0.05 * np.eye(cal.coefficients.size)
    for i in range(4):
        up, down = (
            np.array([naive(cal, c, field[i], positions[i]) for c in cal.coefficients + sign * steps])
            for sign in (1.0, -1.0)
        )
        J = (up - down).T / 0.1
        A, _ = cal.matrices(positions[i : i + 1])
        V = J @ cal.covariance @ J.T + cal.noise.sensor**2 * A[0] @ A[0].T
        u = got.vector[i] / got.total[i]
        np.testing.assert_allclose(got.sigma[i], np.sqrt(u @ V @ u), rtol=1e-5)
        np.testing.assert_allclose(got.vector_sigma[i], np.sqrt(np.diag(V)), rtol=1e-5)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    k=st.integers(0, 3),
    order=st.integers(0, 3),
    boresight=st.booleans(),
    extra=st.booleans(),
    n=st.integers(1, 700),
    hold=st.integers(1, 50),
)
def test_one_by_one_and_all_at_once_agree_to_1e_12(
    seed: int, k: int, order: int, boresight: bool, extra: bool, n: int, hold: int
) -> None:
    cal = random_calibration(seed, max(k, 1) if extra else k, order, boresight=boresight, extra=extra)
    field, channels, time = random_samples(seed + 1, n, len(cal.channels))
    channels = np.repeat(channels[::hold], hold, axis=0)[:n]
    rng = np.random.default_rng(seed)
    field[rng.random(n) < 0.02] = np.nan
    channels[rng.random(channels.shape) < 0.02] = np.nan
    batch, covariance = correct(cal, field, channels, time), vector_covariance(cal, field, channels, time)
    live = Corrector(cal)
    for i in range(n):
        one = live.step(round(time[i] * 1e6), tuple(field[i].tolist()), channels[i].tolist())
        assert one.quality == batch.quality[i]
        np.testing.assert_allclose(one.total_field, batch.total[i], rtol=1e-12)
        np.testing.assert_allclose(one.field, batch.vector[i], rtol=0.0, atol=1e-12 * F_0)
        np.testing.assert_allclose(one.total_field_sigma, batch.sigma[i], rtol=1e-12)
        np.testing.assert_allclose(one.field_sigma, batch.vector_sigma[i], rtol=1e-12)
        if np.isfinite(one.total_field):
            own = np.reshape(live.vector_covariance(), (3, 3))
            np.testing.assert_allclose(own, covariance[i], rtol=1e-9, atol=1e-12 * covariance[i].max())


def test_one_sample_is_summed_in_one_order_on_any_processor() -> None:
    """A replay on another computer gives the same bytes: no matrix product, no fused operation."""
    kernel = random_calibration(5).kernel
    rng = np.random.default_rng(5)
    for position in rng.uniform(-1.2, 1.4, (20, 2)).tolist():
        phi = kernel.monomials(position, 1.0)
        expected = [0.0] * TABLE_SUMS
        for row, (i, j) in zip(kernel.table.T.tolist(), kernel.pairs, strict=True):
            expected = [total + share * (phi[i] * phi[j]) for total, share in zip(expected, row, strict=True)]
        assert kernel.sums_of_one(phi) == expected


def test_what_is_missing_is_flagged_and_never_a_number() -> None:
    cal = random_calibration(5)
    live = Corrector(cal)
    good = (20_000.0, 0.0, 45_000.0)
    for field, values, flag in (
        ((np.nan, 0.0, 1.0), (0.0, 0.0), Quality.GAP),
        ((1e300, 0.0, 1.0), (0.0, 0.0), Quality.GAP),
        *((field, (0.0, 0.0), Quality.GAP) for field in np.diag([1e20, -1e20, 1e20]).tolist()),
        (good, (np.nan, 0.0), Quality.STALE_TELEMETRY),
        *((good, (x, 0.0), Quality.STALE_TELEMETRY) for x in (3e4, -1e6, 1e30, 1e200, np.inf)),
    ):
        got = live.step(0, tuple(field), values)
        many = correct(cal, np.array([field]), np.array([values]), np.zeros(1))
        assert many.quality[0] == got.quality
        assert np.isnan(many.total[0])
        assert np.isnan(got.total_field)
        assert got.total_field_sigma == np.inf
        assert got.quality & flag
    assert live.step(0, good, (0.0, 0.0), Quality.MOVING).quality == Quality.MOVING | Quality.NO_BORESIGHT
    assert live.step(0, (0.0, 0.0, 0.0), (0.0, 0.0)).total_field_sigma > 0.0


def test_an_effect_may_follow_a_channel_in_any_unit() -> None:
    """A pressure in Pa must give the same field as one in dbar."""
    rng = np.random.default_rng(9)
    field, position, time = random_samples(9, 50, 2)
    dbar = rng.uniform(0.0, 1000.0, 50)
    found = []
    for unit in (1.0, 1e4, 1e-6):
        cal = random_calibration(9)
        k = len(cal.coefficients)
        covariance = np.zeros((k + 3, k + 3))
        covariance[:k, :k], covariance[k:, k:] = cal.covariance, np.eye(3) * (0.01 / unit) ** 2
        cal = replace(
            cal,
            effects=(ChannelEffect(cause="pressure_offset", channel="pressure"),),
            coefficients=np.append(cal.coefficients, np.array([0.1, -0.05, 0.02]) / unit),
            covariance=covariance,
        )
        channels = np.column_stack([position, dbar * unit])
        found.append(correct(cal, field, channels, time))
        live = Corrector(cal).step(0, tuple(field[7].tolist()), channels[7].tolist())
        assert live.total_field == pytest.approx(found[-1].total[7], rel=1e-12)
    for other in found[1:]:
        np.testing.assert_allclose(other.total, found[0].total, atol=1e-6)
        np.testing.assert_allclose(other.sigma, found[0].sigma, rtol=1e-6)


def test_extrapolation_is_flagged_and_sigma_grows() -> None:
    cal = random_calibration(6)
    field = np.repeat([[20_000.0, 1000.0, 45_000.0]], 3, axis=0)
    got = correct(cal, field, np.array([[0.1, 0.1], [1.9, 0.1], [2.9, 0.1]]), np.arange(3.0))
    flagged = got.quality & Quality.EXTRAPOLATED
    assert flagged.tolist() == [0, Quality.EXTRAPOLATED, Quality.EXTRAPOLATED]
    assert got.sigma[0] < got.sigma[1] < got.sigma[2]


def test_a_boresight_turns_the_vector_and_leaves_the_magnitude() -> None:
    sighted = random_calibration(7, boresight=True)
    blind = replace(sighted, boresight=None)
    samples = random_samples(8, 50, 2)
    got, raw = correct(sighted, *samples), correct(blind, *samples)
    np.testing.assert_allclose(got.total, raw.total, rtol=1e-11)
    np.testing.assert_allclose(got.vector, raw.vector @ sighted.boresight.matrix().T, rtol=1e-9, atol=1e-6)
    assert (raw.quality & Quality.NO_BORESIGHT).all()
    inside = [raw.quality == Quality.NO_BORESIGHT]
    assert np.any(inside)
    assert not got.quality[tuple(inside)].any()
    assert not (got.quality & Quality.NO_BORESIGHT).any()
    assert (np.linalg.norm(got.vector_sigma, axis=1) > np.linalg.norm(raw.vector_sigma, axis=1)).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, 3.1])
def test_the_boresight_s_matrix_is_that_of_its_rotation_vector(angle: float) -> None:
    rotation = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    matrix = turned(tuple(rotation.tolist()), 1e-6 * np.eye(3)).matrix()
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(rotation).as_matrix(), atol=1e-12)


def test_the_boresight_s_covariance_turns_the_vector() -> None:
    """The covariance is ``V + [b] Omega [b]^T``, tested with a full Omega; the total field is unaffected."""
    field, positions, time = random_samples(8, 5, 2)
    root = np.array([[2.0, 0.0, 0.0], [0.7, 1.0, 0.0], [-0.5, 0.4, 1.5]]) * 1e-3
    sharp = replace(random_calibration(8), boresight=Boresight((0.0, 0.0, 0.0), ((0.0,) * 3,) * 3))
    loose = replace(sharp, boresight=turned((0.0, 0.0, 0.0), root @ root.T))
    before, after = (correct(cal, field, positions, time) for cal in (sharp, loose))
    np.testing.assert_array_equal(after.sigma, before.sigma)
    for b, one, other in zip(before.vector, before.vector_sigma, after.vector_sigma, strict=True):
        cross = np.cross(np.eye(3), b)
        np.testing.assert_allclose(other**2, one**2 + np.diag(cross @ root @ root.T @ cross.T), rtol=1e-9)


@pytest.mark.parametrize("extra", [False, True])
def test_forward_is_the_inverse(extra: bool) -> None:
    cal = random_calibration(10, boresight=True, extra=extra)
    truth, channels, time = random_samples(11, 60, len(cal.channels))
    reading = forward(cal, truth, channels, time)
    np.testing.assert_allclose(correct(cal, reading, channels, time).vector, truth, atol=1e-6)


def test_wrong_number_of_channels_is_one_clear_line() -> None:
    cal = random_calibration(12)
    with pytest.raises(CalibrationError, match=r"expected shape \(1, 2\) for p0, p1, got shape \(1, 1\)"):
        correct(cal, np.zeros((1, 3)), np.zeros((1, 1)), np.zeros(1))
    with pytest.raises(CalibrationError, match="expected 2 values"):
        Corrector(cal).step(0, (0.0, 0.0, 0.0), (1.0,))


def test_a_change_of_position_is_the_difference_of_the_totals() -> None:
    cal = random_calibration(3, boresight=True)
    field, positions, _ = random_samples(4, 40, 2)
    corrector = Corrector(cal)
    for h, p in zip(field.tolist(), positions.tolist(), strict=True):
        there, spans = corrector.step(0, tuple(h), p).total_field, [(0, 0.0, p[0]), (1, -0.5, p[1])]
        elsewhere = [corrector.step(0, tuple(h), at).total_field for at in ((0.0, p[1]), (p[0], -0.5))]
        moved = corrector.changes(tuple(h), tuple(p), spans)
        assert moved == pytest.approx([there - value for value in elsewhere], abs=1e-11 * there)
        assert corrector.changes(tuple(h), tuple(p), spans) == moved
        assert corrector.changes(tuple(h), (*p, 3.0), [*spans, (2, 0.0, 1.0)]) == moved


def test_the_effects_of_independent_errors_make_up_sigma() -> None:
    cal = replace(random_calibration(3, boresight=True, extra=True), noise=Noise(0.0))
    field, channels, _ = random_samples(4, 20, len(cal.channels))
    corrector = Corrector(cal)
    for i, (h, values) in enumerate(zip(field.tolist(), channels.tolist(), strict=True)):
        sigma = corrector.step(i * 4_000_000, tuple(h), values).total_field_sigma
        assert np.sqrt(np.sum(corrector.error_effects() ** 2)) == pytest.approx(sigma, rel=1e-6)
