"""A calibration from the prediction of a fleet, before any run."""

from __future__ import annotations

import numpy as np

from magbridge.calibration.model import Calibration, Noise, Reference
from magbridge.calibration.terms import Polynomial
from magbridge.fleet.learn import Fleet
from magbridge.version import __version__

__all__ = ["unflown"]


def unflown(fleet: Fleet, vehicle: str, refit: str = "") -> Calibration:
    """Return the prediction of a vehicle's next deployment as a calibration.

    Its noise is what that of its deployments was in the mean (of power), or of its fleet's, if it has none.

    Parameters
    ----------
    fleet : Fleet
        The estimates.
    vehicle, refit : str
        As for :meth:`Fleet.known`.
    """
    known = fleet.known(vehicle, refit)
    own = [one.noise for one in fleet.lessons if one.vehicle == vehicle]
    noise = float(np.sqrt(np.mean(np.square(own or [one.noise for one in fleet.lessons]))))
    return Calibration(
        known.parameters, (Polynomial(exponents=known.exponents),), np.asarray(known.mean), known.covariance,
        Noise(noise), Reference(known.field), method="fleet", software=f"magbridge {__version__}",
        warnings=("no run of this deployment: its coefficients are its fleet's prediction",),
    )  # fmt: skip
