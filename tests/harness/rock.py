"""Random crustal fields as sums of waves, for tests of surveys and of localisation."""

import numpy as np

from magbridge.arrays import FloatArray


class Rock:
    """Gaussian crustal field of `size` nT (RMS) and the correlation `length`, m, above its sources."""

    def __init__(self, rng: np.random.Generator, size: float, length: float, count: int = 500) -> None:
        self.k, self.phase = rng.normal(0, 1 / length, (count, 2)), rng.uniform(0, 2 * np.pi, count)
        self.amplitude: FloatArray | float = size * np.sqrt(2 / count)

    @classmethod
    def of_waves(
        cls,
        size: float,
        number: FloatArray,
        direction: FloatArray,
        phase: FloatArray,
        power: FloatArray | float = 1.0,
    ) -> "Rock":
        """Return a field of waves, (m,) each: wave numbers, rad/m, directions and phases, rad, and power."""
        rock = cls(np.random.default_rng(0), size, 1.0, len(phase))
        rock.k = number[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        rock.phase, power = phase, np.broadcast_to(power, len(phase))
        rock.amplitude = size * np.sqrt(2.0 * power / power.sum())
        return rock

    def at(self, place: FloatArray, deeper: FloatArray | float = 0.0) -> FloatArray:
        """Return the anomaly (n,), nT, at places (n, 2), m, `deeper` (n,), m, than the reference level."""
        growth = np.exp(np.reshape(deeper, (-1, 1)) * np.linalg.norm(self.k, axis=1))
        return np.asarray((growth * np.cos(place @ self.k.T + self.phase) * self.amplitude).sum(axis=1))
