"""The reference's error along the track, with the noise of a calibration: see the base class."""

from __future__ import annotations

from magbridge.calibration.model import Noise
from magbridge.estimation.track_process import CORRELATION_LENGTH_M as LENGTH
from magbridge.estimation.track_process import TRACK_STATES as STATES
from magbridge.estimation.track_process import TrackProcess

__all__ = ["LENGTH", "STATES", "Nuisance"]


class Nuisance(TrackProcess):
    """Dynamics of the reference's error for the samples of a calibration.

    Parameters
    ----------
    noise : Noise
        The calibration's noise model.
    spread, level : float
        1-sigma of the crustal field and of the reference's constant error, nT.
    length : float
        Correlation length of the crustal field, m.
    """

    def __init__(self, noise: Noise, spread: float, level: float = 0.0, length: float = LENGTH) -> None:
        super().__init__(
            noise.sensor, spread, level, length,
            noise.autocorrelation, noise.interval, noise.white, noise.reference,
        )  # fmt: skip
