"""The bound of localisation without a map: the smallest error of a drift that crossings could show."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.navigate.own_field import OwnField

__all__ = ["own_bound", "with_bound"]


def own_bound(
    field: OwnField, place: FloatArray, slopes: FloatArray, typical: FloatArray, kind: int
) -> FloatArray:
    """Return the smallest covariance (n, 2, 2), m², that any estimator of the drift could reach.

    Parameters
    ----------
    field : OwnField
        The measured field.
    place, slopes : (n, 2) array
        The true places, m, and the field's slopes there, nT/m; NaN where not known: such blocks tell nothing.
    typical : (q,) array
        Unknowns of which size, length and noise are taken.
    kind : int
        Of the field.

    Notes
    -----
    Field and drift are linearised at the truth, jointly Gaussian; with the field integrated out the posterior
    Cramér-Rao bound of the drift's weights is ``(I + G' K^-1 G)^-1``, G the slopes times the drift's
    functions (Tichavský, Muravchik & Nehorai 1998, eq. 21, for one batch). The field's covariance is taken
    as known.
    """
    whole = np.asarray(np.isfinite(np.hstack([place, slopes])).all(axis=1))
    K = field.covariance(np.where(whole[:, None], place, 0.0), typical, kind)[0][np.ix_(whole, whole)]
    felt = slopes[whole] + field.slope[whole]
    W = field.drift
    G = np.hstack([felt[:, :1] * W[whole], felt[:, 1:] * W[whole]])
    P = np.linalg.inv(np.eye(G.shape[1]) + G.T @ np.linalg.solve(K, G))
    return np.asarray(np.einsum("nr,arbs,ns->nab", W, P.reshape(2, field.r, 2, field.r), W))


def with_bound(
    result: xr.Dataset, field: OwnField, moved: FloatArray, typical: FloatArray, kind: int
) -> xr.Dataset:
    """Add the smallest error possible, m, to a track that is `moved` (n, 2), m, and whose error is known."""
    error = np.stack([result["error_north"], result["error_east"]], axis=1)
    true = field.place + moved - error
    whole = np.isfinite(true).all(axis=1)
    slopes = field.slopes(np.where(whole[:, None], true, field.place), typical, kind)
    P = own_bound(field, true, slopes, typical, kind)
    about = {"units": "m", "long_name": "smallest possible position error (DRMS)"}
    return result.assign(bound_sigma=("time", np.sqrt(np.trace(P, axis1=1, axis2=2)), about))
