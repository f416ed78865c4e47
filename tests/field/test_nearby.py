"""The quadratic that stands in for the series, against the series."""

from __future__ import annotations

import numpy as np
import pytest

from magbridge.errors import OutOfRange
from magbridge.field.geodesy import offset
from magbridge.field.igrf import NearbyField, total_field

TIME = 1.7e9


@pytest.mark.parametrize("place", [(49.5, -57.9), (-30.0, 10.0), (75.0, 179.9), (0.0, -70.0)])
def test_is_the_series_within_its_reach(place: tuple[float, float]) -> None:
    """0.05 nT anywhere within 20 km, a dive and twenty days; and it goes along when the vehicle leaves."""
    rng = np.random.default_rng(0)
    nearby = NearbyField()
    nearby.field_and_slopes(*place, 0.0, TIME)
    for reach in (20_000.0, 60_000.0):
        for _ in range(40):
            there = offset(*place, *rng.uniform(-reach, reach, 2).tolist())
            depth, time = rng.uniform(0.0, 1000.0), TIME + rng.uniform(-1e6, 1e6)
            field = nearby.field_and_slopes(*there, depth, time)[0]
            assert field == pytest.approx(total_field(there[1], there[0], depth, time)[0], abs=0.05)


def test_its_slopes_are_its_own() -> None:
    nearby = NearbyField()
    nearby.field_and_slopes(49.5, -57.9, 0.0, TIME)
    here = offset(49.5, -57.9, 5000.0, -6000.0)
    _, north, east = nearby.field_and_slopes(*here, 100.0, TIME)
    for slope, step in ((north, (50.0, 0.0)), (east, (0.0, 50.0))):
        ahead = nearby.field_and_slopes(*offset(*here, *step), 100.0, TIME)[0]
        behind = nearby.field_and_slopes(*offset(*here, -step[0], -step[1]), 100.0, TIME)[0]
        assert slope == pytest.approx((ahead - behind) / 100.0, abs=1e-5)


def test_refuses_what_the_series_refuses() -> None:
    with pytest.raises(OutOfRange, match="the IGRF covers"):
        NearbyField().field_and_slopes(0.0, 0.0, 0.0, 4e9)
    assert (
        NearbyField().field_and_slopes(0.0, 0.0, 0.0, 1.89e9)[0] > 20_000
    )  # less than LONG before the model's end
