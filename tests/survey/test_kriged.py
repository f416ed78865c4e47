"""Test kriging from the nearest samples, for an area too large for nodes as fine as its field."""

import numpy as np
import pytest
from rock import Rock

from magbridge.arrays import FloatArray
from magbridge.estimation.residual import rms
from magbridge.survey import gridding
from magbridge.survey.kriged import Kriged, kriged
from magbridge.survey.samples import Samples

BELOW, SIZE, NOISE, APART = 500.0, 40.0, 1.0, 350.0
ASTRAY, OFF = 11, 300.0
"""The line that was flown elsewhere than it says, and how many m."""


def layer(seed: int) -> Rock:
    """Return sources in a layer: waves of random directions and numbers k, with the power k exp(-2 k d)."""
    rng = np.random.default_rng(seed)
    k, (way, phase) = rng.uniform(0.0, 6.0 / BELOW, 600), rng.uniform(0.0, 2.0 * np.pi, (2, 600))
    return Rock.of_waves(SIZE, k, way, phase, k * np.exp(-2.0 * k * BELOW))


def surveyed(rock: Rock) -> Samples:
    """Return samples every 100 m on 24 lines of 12 km, one of which is off its stated place."""
    rng = np.random.default_rng(1)
    line, along = np.repeat(np.arange(24), 120), np.tile(100.0 * np.arange(120), 24)
    place = np.stack([along, APART * line], axis=1)
    truly = place + np.outer(line == ASTRAY, [0.0, OFF])
    n = len(line)
    return Samples(
        place, np.zeros(n), np.full(n, np.nan), rock.at(truly) + rng.normal(0.0, NOISE, n), line,
        np.zeros(n, bool), (0.0, 0.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def found() -> tuple[Rock, Samples, Kriged]:
    rock = layer(5)
    samples = surveyed(rock)
    return rock, samples, kriged(samples, samples.value, 2.0 * BELOW)


def between(*, astray: bool) -> FloatArray:
    """Return places half way between lines, next to the wrong line or far from it."""
    line = np.arange(1, 22)
    line = line[(np.abs(line + 0.5 - ASTRAY) < 1.0) == astray]
    return np.stack(np.meshgrid(np.arange(1000.0, 11_000.0, 300.0), APART * (line + 0.5)), axis=-1).reshape(
        -1, 2
    )


def test_depth_size_and_noise_are_found(found: tuple[Rock, Samples, Kriged]) -> None:
    _, _, one = found
    assert one.below == pytest.approx(BELOW, rel=0.25)
    assert one.size == pytest.approx(SIZE, rel=0.6)
    assert one.noise == pytest.approx(NOISE, rel=0.3)


def test_sigma_between_lines_is_consistent_also_next_to_a_wrong_line(
    found: tuple[Rock, Samples, Kriged],
) -> None:
    """The other lines detect that line, and its weight is smaller."""
    rock, _, one = found
    assert np.argmax(one.share) == ASTRAY
    assert np.median(one.share) < 0.1 < one.share[ASTRAY]
    for astray in (False, True):
        place = between(astray=astray)
        mean, variance = one.evaluate(place)
        assert 0.4 < rms((mean - rock.at(place)) / np.sqrt(variance)) < 1.25


def test_a_map_is_kriged_where_its_nodes_are_too_coarse(
    found: tuple[Rock, Samples, Kriged], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in an area of which 40,000 nodes are not fine enough: it is as good as on fine ones."""
    rock, samples, _ = found
    samples = samples.part((samples.line < 7) & (np.arange(len(samples.line)) % 2 == 0))
    searched = gridding._searched(samples, NOISE, local=False)
    monkeypatch.setattr(gridding, "_searched", lambda *_, **__: searched)
    fine = gridding.gridded(samples, local=False)
    monkeypatch.setattr(gridding, "MAX_GRID_NODES", fine.field.nodes.size // 8)
    coarse = gridding.gridded(samples, local=False)
    assert fine.kriged is None
    assert coarse.kriged is not None
    place = between(astray=False)
    place = place[place[:, 1] < 6.0 * APART]
    mean, sigma = coarse.evaluate(place)
    error = mean - rock.at(place)
    assert rms(error) < 1.2 * rms(fine.evaluate(place)[0] - rock.at(place))
    assert 0.4 < rms(error / sigma) < 1.25
    assert coarse.sigma == pytest.approx(NOISE, rel=0.3)  # and not what the nodes leave out
