"""Test that the hierarchical model equals a dense Gaussian, with consistent sigmas."""

import numpy as np
import pytest

from magbridge.arrays import FloatArray
from magbridge.estimation.information import GaussianInformation
from magbridge.fleet.hierarchy import NO_SHAPES, Observed, Shapes, Variances, learn


def observed(
    rng: np.random.Generator, sigmas: tuple[float, ...], fleet: tuple[int, ...], K: int = 4
) -> tuple[list[Observed], list[FloatArray]]:
    """Draw a fleet; each deployment sees two random combinations of its K coefficients, to 0.05."""
    out, truth = [], []
    mean = rng.normal(size=K)
    for v in range(fleet[0]):
        vehicle = mean + sigmas[0] * rng.normal(size=K)
        for r in range(fleet[1]):
            refit = vehicle + sigmas[1] * rng.normal(size=K)
            for _ in range(fleet[2]):
                z = refit + sigmas[2] * rng.normal(size=K)
                H = rng.normal(size=(2, K)) / 0.05
                y = H @ z + rng.normal(size=2)
                out.append(Observed(str(v), str(r), GaussianInformation(H.T @ H, H.T @ y)))
                truth.append(z)
    return out, truth


@pytest.mark.parametrize("vehicle", ["1", "unknown"])
@pytest.mark.parametrize("shaped", [False, True])
def test_what_is_expected_is_the_dense_gaussians_answer(vehicle: str, *, shaped: bool) -> None:
    rng = np.random.default_rng(0)
    seen, _ = observed(rng, (1.0, 0.3, 0.1), (2, 2, 2), K=3)
    V = np.array([[1.0, 0.5, 2.0], [0.1, 0.2, 0.3], [0.01, 0.02, 0.03]])
    D, u = {"0": rng.normal(size=(3, 2)), "1": rng.normal(size=(3, 2))}, np.array([0.5, 2.0])
    shapes = Shapes(D, np.arange(2)) if shaped else NO_SHAPES
    variances = Variances(V, u if shaped else np.zeros(0))
    population = learn(seen, np.arange(3), shapes, variances)
    mean, P = population.expected(vehicle, [one for one in seen if one.vehicle == vehicle], "0")
    # the dense joint of all deployments and the next one, by its covariances
    labels = [(one.vehicle, one.refit) for one in seen] + [(vehicle, "0")]

    def shared(a: tuple[str, str], b: tuple[str, str]) -> FloatArray:
        shape = D.get(a[0], np.zeros((3, 2)))
        refit = np.diag(V[1]) + (shape * u) @ shape.T * shaped
        return np.asarray(np.eye(3) + np.diag(V[0]) * (a[0] == b[0]) + refit * (a == b))

    S = np.block([[shared(a, b) for b in labels] for a in labels])
    S += np.kron(np.eye(len(labels)), np.diag(V[2]))
    J, h = np.zeros_like(S), np.zeros(len(S))
    for k, one in enumerate(seen):
        J[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = one.information.precision
        h[3 * k : 3 * k + 3] = one.information.vector
    posterior = np.linalg.inv(np.linalg.inv(S) + J)
    np.testing.assert_allclose(P, posterior[-3:, -3:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(mean, (posterior @ h)[-3:], rtol=1e-6, atol=1e-9)


def test_the_variances_are_those_that_it_was_drawn_from() -> None:
    sigmas = (0.8, 0.2, 0.05)
    seen, _ = observed(np.random.default_rng(2), sigmas, (15, 3, 3))
    found = np.sqrt(learn(seen, np.zeros(4, int)).variances.own[:, 0])
    assert (np.abs(np.log(found / sigmas)) < 0.35).all()


def test_refits_that_move_coefficients_together_are_separated_from_those_that_do_not() -> None:
    rng = np.random.default_rng(5)
    K, u, size = 4, 0.5, 0.03
    D = {str(v): rng.normal(size=(K, 2)) for v in range(10)}
    seen = []
    for v, shape in D.items():
        vehicle = rng.normal(size=K)
        for r in range(3):
            z = vehicle + shape @ rng.normal(0, u, 2) + rng.normal(0, size, K)
            H = rng.normal(size=(3, K)) / 0.02
            y = H @ z + rng.normal(size=3)
            seen.append(Observed(v, str(r), GaussianInformation(H.T @ H, H.T @ y)))
    groups, shapes = np.zeros(K, int), Shapes(D, np.zeros(2, int))
    shaped, plain = learn(seen, groups, shapes), learn(seen, groups)
    assert np.sqrt(shaped.variances.shaped[0]) == pytest.approx(u, rel=0.3)
    assert shaped.variances.own[1, 0] < 0.1 * plain.variances.own[1, 0]
    # one number of a new refit, and so much more of all is known
    past = [one for one in seen if one.vehicle == "9"]
    left = []
    for population in (shaped, plain):
        _, P = population.expected("9", past, "new")
        left.append(np.trace(np.linalg.inv(np.linalg.inv(P) + np.diag([0.0, 0.0, 1e4, 1e4]))))
    assert left[0] < 0.3 * left[1]
