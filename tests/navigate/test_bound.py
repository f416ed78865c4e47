"""Test the posterior Cramér-Rao bound in cases with a closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magbridge.errors import OutOfRange
from magbridge.field.grid import AnomalyGrid
from magbridge.navigate import NavigationOptions, position_bound
from magbridge.navigate.bound import as_dataset
from magbridge.navigate.draw import draw_bound

TRACK = ([1.4e9, 1.4e9 + 7200, 1.4e9 + 14400], [49.48, 49.5, 49.5], [-57.95, -57.9, -57.85])
STILL = NavigationOptions(start_sigma=100.0, current_sigma=1e-9, drift=1e-9, bias_sigma=1e-9, map_sigma=1e-9)


def slope(grid: AnomalyGrid, per_degree: float) -> AnomalyGrid:
    x, _ = np.meshgrid(grid.longitude, grid.latitude)
    return AnomalyGrid(grid.longitude, grid.latitude, (x + 57.9) * per_degree)


def test_on_a_plane_it_is_the_line_fit(grid: AnomalyGrid) -> None:
    """Along a slope g, N samples of sigma: 1/var = 1/start² + N g²/sigma²; across it stays at its start.

    The main field's own slope, 4 nT/km, adds to the plane's 100 nT/km: 6 %.
    """
    g = 0.1
    bound = position_bound(slope(grid, g * 72_400.0), *TRACK, STILL, sigma=5.0, every=4.0)
    along, across = np.sqrt(np.linalg.eigvalsh(bound.covariance[-1, :2, :2]))
    expected = 1 / np.sqrt(1 / 100.0**2 + 3600 * g**2 / 25.0)
    assert along == pytest.approx(expected, rel=0.06)
    assert across == pytest.approx(100.0, rel=0.01)


def test_a_map_helps_and_noise_hurts(grid: AnomalyGrid, options: NavigationOptions) -> None:
    good = position_bound(grid, *TRACK, options, 1.0)
    poor = position_bound(grid, *TRACK, options, 10.0)
    assert good.sigma[-1] < poor.sigma[-1] < poor.unaided[-1]
    assert (good.sigma <= good.unaided + 1e-9).all()


def test_off_the_map_it_is_dead_reckoning(grid: AnomalyGrid, options: NavigationOptions) -> None:
    moved = AnomalyGrid(grid.longitude + 10.0, grid.latitude, grid.anomaly)
    bound = position_bound(moved, *TRACK, options)
    np.testing.assert_allclose(bound.sigma, bound.unaided)


@pytest.mark.parametrize("way", [1, -1], ids=["east", "west"])
def test_across_the_date_line(grid: AnomalyGrid, options: NavigationOptions, way: int) -> None:
    """The bound equals that of any other place, except for the main field."""
    turn = 180.0 - 57.9
    there = AnomalyGrid(grid.longitude - turn, grid.latitude, grid.anomaly)
    time, latitude, longitude = TRACK[0], TRACK[1][::way], TRACK[2][::way]
    crossing = [(degrees - turn + 180.0) % 360.0 - 180.0 for degrees in longitude]
    bound = position_bound(there, time, latitude, crossing, options)
    assert np.ptp(bound.longitude) > 359.0
    assert (np.abs(bound.longitude) <= 180.0).all()
    expected = position_bound(grid, time, latitude, longitude, options)
    assert bound.sigma[-1] == pytest.approx(expected.sigma[-1], rel=0.15)


def test_time_must_increase(grid: AnomalyGrid) -> None:
    with pytest.raises(OutOfRange, match="must increase"):
        position_bound(grid, TRACK[0][::-1], *TRACK[1:])
    with pytest.raises(OutOfRange, match="track = 1 positions: at least two are needed"):
        position_bound(grid, [1.4e9], [49.48], [-57.95])
    with pytest.raises(OutOfRange, match=r"track = 3 s: at least \d+ s are needed"):
        position_bound(grid, [0.0, 3.0], [49.48] * 2, [-57.95] * 2)


def test_its_sentence_says_when_it_is_best(grid: AnomalyGrid, options: NavigationOptions) -> None:
    bound = position_bound(grid, *TRACK, options)
    for sigma, words in (
        (np.linspace(50.0, 90.0, bound.time.size), "at best 50 m at the start, at the end 90 m"),
        (np.linspace(90.0, 50.0, bound.time.size), f"at best 50 m after {np.ptp(bound.time) / 3600.0:.1f} h"),
    ):
        assert as_dataset(bound._replace(sigma=sigma), grid).attrs["findings"].startswith(words)


def test_its_picture(grid: AnomalyGrid, options: NavigationOptions, tmp_path: Path) -> None:
    draw_bound(position_bound(grid, *TRACK, options), grid, tmp_path / "bound.png")
    assert (tmp_path / "bound.png").stat().st_size > 20_000


def test_more_samples_allow_a_smaller_error(grid: AnomalyGrid, options: NavigationOptions) -> None:
    """Twenty times as many of the same noise: a filter at 5 Hz must not beat the bound that was printed."""
    slow, fast = (position_bound(grid, *TRACK, options, 50.0, every=every).sigma[-1] for every in (4.0, 0.2))
    assert fast < 0.8 * slow
