"""Test the Gaussian field and its normal equations against dense algebra and Laplace's equation."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from magbridge.calibration.fitting.field_search import nodes_for
from magbridge.estimation.elimination import LinearisedRows, eliminate_field, sum_rows
from magbridge.estimation.gaussian_field import GaussianField
from magbridge.estimation.nodes import nodes_near
from magbridge.estimation.sparse import SparseFactor, inverse_blocks


@pytest.mark.parametrize(
    ("alpha", "harmonic", "buried"),
    [
        (2, False, False),
        (3, False, False),
        (4, False, False),
        (4, True, False),
        (10, True, False),
        (4, False, True),
    ],
)
def test_prior_has_unit_variance_and_its_inverse_is_exact(alpha: int, harmonic: bool, buried: bool) -> None:
    """Away from edges the splines' variance is 1; blocks of the inverse are those of the dense one.

    Of sources at a depth the edge is felt farther.
    """
    rng = np.random.default_rng(alpha)
    place = np.cumsum(rng.normal(0, 60, (1500, 2)), axis=0)
    field = GaussianField(nodes_near(place, 400.0, 1000.0), 1000.0, alpha, harmonic, buried)
    Q = field.precision.toarray()
    B = field.basis(place[::9])
    variance = inverse_blocks(field.precision, field.edges(field.precision)).variances(B)
    np.testing.assert_allclose(variance, np.einsum("ni,ij,nj->n", B.toarray(), np.linalg.inv(Q), B.toarray()))
    np.testing.assert_allclose(variance, 1.0, atol=0.2 if buried else 0.05)
    assert field.log_determinant == pytest.approx(np.linalg.slogdet(Q)[1])
    # the stated condition is a bound: the Laplacian of a grid has eigenvalues from 0 to below 8
    assert np.linalg.cond(Q) <= field.condition <= 4.0 * np.linalg.cond(Q)
    factor = SparseFactor(field.precision)
    assert factor.log_determinant == pytest.approx(field.log_determinant)
    root = factor.draw(np.eye(field.nodes.size))
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(Q), atol=1e-6 * np.abs(np.linalg.inv(Q)).max())


def test_blocks_span_the_nodes_of_two_samples_whose_noise_is_correlated() -> None:
    """Steps of ten nodes' spacing couple more nodes than the splines do."""
    place = np.random.default_rng(2).uniform(0.0, 300.0, (12, 2))
    place[:, 0] = np.linspace(0.0, 5500.0, 12)
    field = GaussianField(nodes_near(place, 50.0, 150.0), 150.0, 2)
    B = field.basis(place)
    sums = sum_rows([LinearisedRows(np.ones((12, 1)), B, np.arange(12) > 0)])
    N = eliminate_field(sums, field, 50.0, 0.9).precision
    variance = inverse_blocks(N, field.edges(N)).variances(B)
    np.testing.assert_allclose(variance, np.einsum("ni,ni->n", B.toarray(), B @ np.linalg.inv(N.toarray())))


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.99])
def test_sums_are_those_of_the_whitened_samples_however_they_are_cut(rho: float) -> None:
    """The pieces have a gap, a gap at a boundary between pieces, and a single sample."""
    rng = np.random.default_rng(4)
    V, B = rng.normal(size=(12, 3)), rng.normal(size=(12, 5))
    follows = np.ones(12, bool)
    follows[[0, 3, 4, 8]] = False
    pieces = [(0, 4), (3, 9), (8, 12)]
    sums = sum_rows(LinearisedRows(V[a:b], csr_array(B[a:b]), follows[a:b], overlap=a > 0) for a, b in pieces)
    both = np.hstack([V, B])
    white = both.copy()
    white[follows] = (both[follows] - rho * both[np.flatnonzero(follows) - 1]) / np.sqrt(1.0 - rho**2)
    found, expected = sums.whitened(rho), white.T @ white
    assert (sums.samples, sums.pairs) == (12, 8)
    np.testing.assert_allclose(found.VV, expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found.VB, expected[:3, 3:], atol=1e-9)
    np.testing.assert_allclose(found.BB.toarray(), expected[3:, 3:], atol=1e-9)


def test_sources_at_a_depth_reach_far_and_are_smooth_nearby() -> None:
    """Their correlation begins to fall as a Gaussian's of the length, and ends as a layer of dipoles'."""
    length = 600.0
    place = np.stack([np.linspace(0.0, 4.0 * length, 33), np.zeros(33)], axis=1)
    field = GaussianField(nodes_near(place, 120.0, 3000.0), length, 4, buried=True)
    B = field.basis(place)
    covariance = B @ SparseFactor(field.precision).solve(B.T.toarray())
    correlation = covariance[0] / covariance[0, 0]
    depth = length * np.sqrt(0.75)  # of a layer whose correlation (1 + r²/4d²)^-3/2 begins to fall so
    layer = (1.0 + place[:, 0] ** 2 / (4.0 * depth**2)) ** -1.5
    np.testing.assert_allclose(correlation, layer, atol=0.06)
    assert correlation[24] > 10.0 * np.exp(-0.5 * 3.0**2)


def test_nodes_too_fine_for_a_long_field_are_refused() -> None:
    """Where the prior is singular to rounding, the evidence is noise that a search would climb."""
    place = np.stack([np.linspace(0.0, 6000.0, 200), np.zeros(200)], axis=1)
    values = np.sin(place[:, 0] / 900.0)

    def evidence(fine: float) -> float:
        field = GaussianField(nodes_near(place, 1500.0 / fine, 1500.0), 1500.0, 16)
        sums = sum_rows(
            [LinearisedRows(np.ones((200, 1)) * values[:, None], field.basis(place), np.zeros(200, bool))]
        )
        reduced = eliminate_field(sums, field, 50.0, 0.0)
        return reduced.log_evidence - 0.5 * reduced.quadratic.constant

    assert evidence(5.0) == pytest.approx(evidence(4.0), abs=0.5)
    with pytest.raises(np.linalg.LinAlgError, match="too fine"):
        evidence(9.0)


def test_nodes_are_as_fine_as_the_area_allows() -> None:
    """A rough field over 100 km of lines: coarser nodes, and no more of them than asked for."""
    x = np.arange(0.0, 100e3, 50.0)
    place = np.concatenate([np.stack([x, 0.0 * x + east], axis=1) for east in np.arange(0.0, 60e3, 1e3)])
    assert 0.7 * 4_000 < nodes_for(place, 300.0, 2, 4_000).size < 1.06 * 4_000
    assert nodes_for(place[:100], 300.0, 2).spacing == pytest.approx(300.0 / 8.0)


@pytest.mark.parametrize("waves", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("deeper", [-150.0, -50.0, 80.0, 150.0])
def test_a_wave_falls_off_upwards_as_laplace_demands(waves: float, deeper: float) -> None:
    """A wave of wave number k is larger by exp(k d) where the track is d deeper."""
    length = 900.0
    x = np.linspace(-4000.0, 4000.0, 400)
    field = GaussianField(nodes_near(np.stack([x, 0.0 * x], axis=1), 300.0, 2000.0), length, 6, harmonic=True)
    k = waves / length
    u = np.cos(k * field.nodes.places[:, 0])
    inner = np.stack([np.linspace(-1500.0, 1500.0, 60), np.zeros(60)], axis=1)
    here, there = (field.basis(inner, depth) @ u for depth in (0.0, deeper))
    lacking = field.lacking(inner, np.full(60, deeper), u)
    np.testing.assert_allclose(there, np.exp(k * deeper) * here, atol=0.02 * np.abs(here).max())
    np.testing.assert_allclose(there + lacking, np.exp(k * deeper) * here, atol=0.008 * np.abs(here).max())
    # a constant field is the same at every depth
    u = np.ones(field.nodes.size)
    np.testing.assert_allclose(field.basis(inner, deeper) @ u, field.basis(inner) @ u)


def test_slopes_are_the_splines_derivatives() -> None:
    nodes = nodes_near(np.array([[0.0, 0.0], [3000.0, 500.0]]), 300.0, 900.0)
    rng = np.random.default_rng(1)
    w, x = rng.normal(size=nodes.size), np.array([[100.0, 50.0], [2900.0, 600.0]])
    step = np.array([[0.5, 0.0]])
    for harmonic in (False, True):
        field = GaussianField(nodes, 900.0, 4, harmonic)
        north, east = (slope @ w for slope in field.slopes(x))
        np.testing.assert_allclose(north, (field.basis(x + step) - field.basis(x - step)) @ w, rtol=1e-4)
        np.testing.assert_allclose(
            east, (field.basis(x + step[:, ::-1]) - field.basis(x - step[:, ::-1])) @ w, rtol=1e-4
        )
