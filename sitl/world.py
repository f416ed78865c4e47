"""Simulate the world: main field, magnetised bodies below the sea floor, and water temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.field.geodesy import offset, separation
from magbridge.field.grid import AnomalyGrid
from magbridge.field.igrf import igrf, total_field
from magbridge.toml import Table

__all__ = ["MU_0_OVER_4_PI", "Geology", "Rock", "Water", "World", "dipole_field"]

MU_0_OVER_4_PI = 100.0
"""Constant µ0/4π, nT m/A (1e-7 T m/A)."""


def dipole_field(r: FloatArray, m: FloatArray) -> FloatArray:
    r"""Return the field (..., 3), nT, of point dipoles m (..., 3), A m², at r (..., 3), m from the dipoles.

    Notes
    -----
    .. math:: \mathbf B = \frac{\mu_0}{4\pi} \left( \frac{3 (\mathbf m \cdot \mathbf r) \mathbf r}{r^5}
              - \frac{\mathbf m}{r^3} \right)

    Blakely 1995, *Potential Theory in Gravity and Magnetic Applications*, eq. 4.14.
    """
    r2 = np.sum(r * r, axis=-1, keepdims=True)
    mr = np.sum(m * r, axis=-1, keepdims=True)
    return np.asarray(MU_0_OVER_4_PI * (3 * mr * r / r2 - m) / (r2 * np.sqrt(r2)))


class Geology(Table, frozen=True):
    """Table ``[world.geology]``: the magnetised bodies that cause the crustal field."""

    sources: int = 600
    """Number of magnetised bodies; 0 for the main field without a crustal field."""
    extent: float = 12_000.0
    """Half the side of the square that contains the bodies, about the first position, m."""
    top: float = 350.0
    bottom: float = 3_000.0
    """`top`, `bottom`: least and greatest depth of the bodies below the surface, m, with equally many bodies
    in each octave of depth. The vehicle stays above the bodies."""
    rms: float = 100.0
    """RMS of the total-field anomaly at the surface, nT."""


class Water(Table, frozen=True):
    """Table ``[world.water]``: temperature (degC) above and below a thermocline (depth, thickness: m)."""

    surface: float = 1.6
    deep: float = 2.4
    thermocline: float = 40.0
    thickness: float = 15.0

    def temperature(self, depth: FloatArray) -> FloatArray:
        """Return the water temperature (n,), degC, at `depth` (n,), m."""
        share = 0.5 * (1 + np.tanh((depth - self.thermocline) / self.thickness))
        return np.asarray(self.surface + (self.deep - self.surface) * share)


@dataclass(frozen=True)
class Rock:
    """Point dipoles below the sea floor, whose field is harmonic everywhere above them."""

    position: FloatArray
    """Positions (m, 3), m north, east and down of the world's origin."""
    moment: FloatArray
    """Magnetic moments (m, 3), A m², north, east and down."""

    @classmethod
    def draw(cls, geology: Geology, main_field: FloatArray, rng: np.random.Generator) -> Rock:
        """Draw random bodies that cause the anomaly `geology` specifies in a `main_field` (3,), nT, NED.

        A body's moment grows with the cube of its depth, so that all depths contribute equally. It is the sum
        of an induced part along the main field and of remanence in a random direction, with a random sign.
        """
        n = geology.sources
        depth = geology.top * (geology.bottom / geology.top) ** rng.random(n)
        position = np.column_stack([rng.uniform(-geology.extent, geology.extent, (n, 2)), depth])
        direction = rng.normal(0, 0.5, (n, 3)) + rng.choice(
            [-1.0, 1.0], (n, 1)
        ) * main_field / np.linalg.norm(main_field)
        rock = cls(position, direction * rng.normal(0, 1, (n, 1)) * depth[:, None] ** 3)
        if n == 0:
            return rock
        side = np.linspace(-geology.extent / 2, geology.extent / 2, 40)
        grid = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
        anomaly = rock.field(grid) @ main_field / np.linalg.norm(main_field)
        return cls(position, rock.moment * geology.rms / np.std(anomaly))

    def field(self, ned: FloatArray, block: int = 4096) -> FloatArray:
        """Return the bodies' field (n, 3), nT NED, at local points `ned` (n, 3), m.

        The field is the sum of :func:`dipole_field` over the bodies, computed by matrix products.
        """
        s, m = self.position, self.moment
        s2, ms = np.sum(s * s, axis=1), np.sum(m * s, axis=1)
        out = np.zeros_like(ned)
        for k in range(0, len(ned) if len(s) else 0, block):
            x = ned[k : k + block]
            r2 = np.sum(x * x, axis=1)[:, None] + s2 - 2 * x @ s.T
            w3 = 1 / (r2 * np.sqrt(r2))
            w5 = 3 * (x @ m.T - ms) * w3 / r2
            out[k : k + block] = MU_0_OVER_4_PI * (x * np.sum(w5, axis=1)[:, None] - w5 @ s - w3 @ m)
        return out


@dataclass(frozen=True)
class World:
    """Model of the Earth's field at any place and time, and of the water."""

    origin: tuple[float, float]
    """Latitude and longitude (deg) of the origin of the local axes."""
    rock: Rock
    water: Water

    @classmethod
    def draw(
        cls,
        origin: tuple[float, float],
        time: float,
        geology: Geology,
        water: Water,
        rng: np.random.Generator,
    ) -> World:
        """Return a world with random bodies about `origin` (deg), magnetised at `time` (s since 1970)."""
        latitude, longitude, depth, when = np.array([[origin[0]], [origin[1]], [0.0], [time]])
        return cls(origin, Rock.draw(geology, igrf(longitude, latitude, depth, when)[0], rng), water)

    def field(
        self, time: FloatArray, latitude: FloatArray, longitude: FloatArray, depth: FloatArray
    ) -> FloatArray:
        """Return the Earth's field (n, 3), nT NED, at times (s since 1970) and positions (deg, deg, m)."""
        north, east = separation(*self.origin, latitude, longitude)
        return igrf(longitude, latitude, depth, time) + self.rock.field(np.column_stack([north, east, depth]))

    def anomaly_map(
        self, time: float, altitude: float = 90.0, extent: float = 8_000.0, spacing: float = 150.0
    ) -> AnomalyGrid:
        """Return the anomaly map of an aeromagnetic survey at an `altitude` (m) and `time` (s since 1970).

        At this altitude the map lacks the fine structure of the field under water. `extent` is half the side
        of the mapped square (m), `spacing` the distance between nodes (m).
        """
        side = np.arange(-extent, extent + spacing / 2, spacing)
        latitude, longitude = offset(*self.origin, side, side)
        lat, lon = (a.ravel() for a in np.meshgrid(latitude, longitude, indexing="ij"))
        when, high = np.full(lat.shape, time), np.full(lat.shape, -altitude)
        total = np.linalg.norm(self.field(when, lat, lon, high), axis=1)
        anomaly = total - total_field(lon, lat, high, when)
        return AnomalyGrid(
            longitude, latitude, anomaly.reshape(len(side), -1), altitude=altitude, name="aeromagnetic map"
        )
