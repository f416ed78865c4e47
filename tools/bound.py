"""How well any calibration could do: the Cramér-Rao bound of the vehicle's true model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import xarray as xr
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.fit import MAIN_FIELD_SIGMA_NT
from sitl.dataset import channels
from sitl.platform import HARD_IRON, MOMENT, SOFT_IRON, VOLUME_SPREAD, Vehicle

DENSE = 2_700
"""Samples of a covariance at most."""

__all__ = ["BestFit", "SurveyBound", "oracle"]


def oracle(vehicle: Vehicle, deployment: xr.Dataset) -> FloatArray:
    """Return the total field (n,), nT, corrected by a calibration that knows the vehicle exactly.

    Its error is the noise floor: the channels' noise in the magnitude. The instrument must have no errors
    of its own but noise.
    """
    D, T = _response(vehicle, deployment)
    raw = channels(deployment)
    return np.asarray(np.linalg.norm(np.linalg.solve(D, (raw - T)[..., None])[..., 0], axis=1))


class BestFit:
    r"""A fit that reaches the Cramér-Rao bound: the least error that the calibration data allow.

    Parameters
    ----------
    vehicle : Vehicle
        The truth: dipoles with a permanent moment, a three-axis induced moment and a position each. The prior
        is the distribution that such vehicles are drawn from.
    calibration, survey : Dataset (time)
        Deployments of :func:`sitl.simulate`, of m and n samples.
    sigma, memory : float
        nT of a channel's noise, and samples over which its correlation falls by e.
    at_sigma : float
        m, how well the masses' positions are known beforehand.
    widths : (k,) array, optional
        1-sigma of the prior instead: soft iron (9), hard iron (3, nT), and of each mass moment
        (3, A m²), volume (3, m³) and place (3, m).

    Attributes
    ----------
    bound : (n,) array
        nT, standard deviation of the survey's corrected total field, noise included.
    floor : (n,) array
        nT, of the noise alone.

    Notes
    -----
    The reading is :math:`\mathbf y = D(p) \mathbf B + \mathbf T(p) + \mathbf n`, and only
    :math:`|\mathbf B|` is known. With :math:`\mathbf w = D^{-T} \mathbf B / |B|`, a change of the parameters
    θ and the noise change the corrected magnitude by :math:`-\mathbf w^T (\partial \mathbf y / \partial θ)
    dθ + \mathbf w^T \mathbf n`. So with g the first factor over :math:`σ |\mathbf w|`, whitened by the
    noise's memory, the information is :math:`\sum \mathbf g \mathbf g^T` plus the prior's (Kay 1993,
    *Estimation Theory*, ch. 3 and 15).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        calibration: xr.Dataset,
        survey: xr.Dataset,
        sigma: float,
        memory: float = 0.0,
        at_sigma: float = 0.05,
        widths: FloatArray | None = None,
    ) -> None:
        self._vehicle, self._calibration, self._survey = vehicle, calibration, survey
        self._phi = np.exp(-1 / memory) if memory else 0.0
        # θ in units of its prior: the information is then well scaled
        scale = _widths(vehicle, at_sigma) if widths is None else widths
        g, self._learned_floor = _sensitivity(vehicle, calibration, sigma)
        self._g = self._whitened(g) * scale
        self._covariance = np.linalg.inv(self._g.T @ self._g + np.eye(len(scale)))
        h, self.floor = _sensitivity(vehicle, survey, sigma)
        self._h = h * scale
        self.bound = np.sqrt(np.einsum("ni,ij,nj->n", self._h, self._covariance, self._h) + self.floor**2)

    def error(self, rng: np.random.Generator) -> FloatArray:
        r"""Return the survey's error (n,), nT, on these very data; the bound is its size on average.

        Notes
        -----
        Linear about the truth: with :math:`\mathbf e` the whitened noise of the calibration and a prior whose
        centre is :math:`\mathbf p` of its widths off the truth,
        :math:`dθ = P (\mathbf g^T \mathbf e + \mathbf p)`.
        """
        noise, after = (
            oracle(self._vehicle, part) - part["truth_total_field"].to_numpy()
            for part in (self._calibration, self._survey)
        )
        e = self._whitened(noise[:, None])[:, 0]
        off = self._covariance @ (self._g.T @ e + rng.normal(size=len(self._covariance)))
        return np.asarray(after - self._h @ off)

    def _whitened(self, values: FloatArray) -> FloatArray:
        """Whiten columns (m, j), nT, on the calibration's samples; each run begins independently."""
        values = values / self._learned_floor[:, None]
        follows = (np.diff(self._calibration["run"].to_numpy(), prepend=np.nan) == 0)[:, None]
        innovations = (values - self._phi * np.roll(values, 1, axis=0)) / np.sqrt(1 - self._phi**2)
        return np.where(follows, innovations, values)


class SurveyBound:
    r"""The least errors after a survey alone: of the field on another one, and of the map.

    Parameters
    ----------
    vehicle : Vehicle
        The truth, as for :class:`BestFit`.
    survey : Dataset (time)
        From which vehicle and crustal field are estimated, of n samples.
    place : (n, 2) array
        m, of its samples.
    crust : tuple of 2 float
        nT and m, of a Gaussian field with a Gaussian covariance, which is known.
    noise : tuple of 2 float
        nT of a channel, and its memory in samples.

    Notes
    -----
    As :class:`BestFit`, with crustal field and bias in the covariance K of the magnitudes:
    :math:`P = (I + G^T K^{-1} G)^{-1}`. The map is the posterior of a Gaussian field whose data have the
    covariance :math:`K + G G^T`. Neighbouring samples are averaged until :data:`DENSE` are left.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        survey: xr.Dataset,
        place: FloatArray,
        crust: tuple[float, float],
        noise: tuple[float, float],
    ) -> None:
        self._vehicle, self._sigma, self._crust = vehicle, noise[0], crust
        self._scale, memory = _widths(vehicle, 0.05), noise[1]
        g, floor = _sensitivity(vehicle, survey, self._sigma)
        step = -(-len(g) // DENSE)
        n = len(g) // step
        g, self._place, floor = (
            one[: n * step].reshape(n, step, -1).mean(axis=1) for one in (g, place, floor[:, None])
        )

        def alike(samples: int, apart: int) -> FloatArray:
            lag = apart * np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
            return np.asarray(np.exp(-lag / memory) if memory else 1.0 * (lag == 0))

        R = alike(n, step)
        np.fill_diagonal(R, alike(step, 1).mean())
        self._G = g * self._scale
        self._K = floor * floor.T * R + self._alike(self._place, self._place) + MAIN_FIELD_SIGMA_NT**2

    def of_field(self, other: xr.Dataset) -> float:
        """Return the least error about its mean of another survey, over the noise floor."""
        h, floor = _sensitivity(self._vehicle, other, self._sigma)
        G, H = self._G, (h - h.mean(axis=0)) * self._scale
        P = np.linalg.inv(G.T @ np.linalg.solve(self._K, G) + np.eye(len(self._scale)))
        return float(np.sqrt(1.0 + np.einsum("ni,ij,nj->", H, P, H) / (floor**2).sum()))

    def data_covariance(self, *, vehicle_known: bool) -> FloatArray:
        """Return the covariance (n, n), nT², of the magnitudes: crustal field, bias, noise, vehicle."""
        return np.asarray(self._K if vehicle_known else self._K + self._G @ self._G.T)

    def of_map(self, at: FloatArray, apart_from: int, *, vehicle_known: bool) -> FloatArray:
        """Return the least error (m,), nT, of the map at places (m, 2), m.

        It excludes the mean error at the first `apart_from` of them.
        """
        K = self.data_covariance(vehicle_known=vehicle_known)
        C = self._alike(at, self._place)
        S = self._alike(at, at) - C @ cho_solve(cho_factor(K), C.T)
        level = S[:apart_from].mean(axis=0)
        return np.asarray(np.sqrt(np.diag(S) - 2.0 * level + level[:apart_from].mean()))

    def _alike(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return the crustal field's covariance (n, m), nT², between places (n, 2) and (m, 2), m."""
        size, length = self._crust
        return np.asarray(size**2 * np.exp(-0.5 * cdist(a, b, "sqeuclidean") / length**2))


def _widths(vehicle: Vehicle, at_sigma: float) -> FloatArray:
    """Return the prior's width of each parameter, (k,), in the order of :func:`_neighbours`."""
    widths = [*[SOFT_IRON] * 9, *[HARD_IRON] * 3]
    for mass in vehicle.mass.values():
        widths += [*[MOMENT] * 3, *(VOLUME_SPREAD * volume for volume in mass.volume), *[at_sigma] * 3]
    return np.array(widths)


def _sensitivity(vehicle: Vehicle, deployment: xr.Dataset, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the derivative of the corrected magnitude by each parameter (n, k), and its noise (n,), nT."""
    ambient = np.column_stack([deployment[f"truth_field_{axis}"] for axis in "xyz"])
    channels = {name: deployment[name].to_numpy() for name in vehicle.channels}
    D, _ = _response(vehicle, deployment)
    u = ambient / np.linalg.norm(ambient, axis=1, keepdims=True)
    w = np.linalg.solve(np.swapaxes(D, 1, 2), u[..., None])[..., 0]
    columns = []
    for up, down, step in _neighbours(vehicle):
        change = (up.field(ambient, channels) - down.field(ambient, channels)) / (2 * step)
        columns.append(-np.sum(w * change, axis=1))
    return np.column_stack(columns), sigma * np.linalg.norm(w, axis=1)


def _response(vehicle: Vehicle, deployment: xr.Dataset) -> tuple[FloatArray, FloatArray]:
    """Return D (n, 3, 3) and T (n, 3): the reading is affine in the ambient field."""
    channels = {name: deployment[name].to_numpy() for name in vehicle.channels}
    n, unit = deployment.sizes["time"], 1e4
    T = vehicle.field(np.zeros((n, 3)), channels)
    D = np.stack(
        [(vehicle.field(np.tile(unit * e, (n, 1)), channels) - T) / unit for e in np.eye(3)], axis=-1
    )
    return D, T


def _neighbours(vehicle: Vehicle) -> Iterator[tuple[Vehicle, Vehicle, float]]:
    """Yield the vehicle with one number a step up, a step down, and the step; in the prior's order."""

    def vary(struct: Any, name: str, step: float) -> Iterator[tuple[Any, Any, float]]:
        value = np.asarray(getattr(struct, name), dtype=np.float64)
        for k in range(value.size):
            moved = []
            for sign in (1, -1):
                other = value.copy()
                other.flat[k] += sign * step
                moved.append(msgspec.structs.replace(struct, **{name: other.tolist()}))
            yield moved[0], moved[1], step

    yield from vary(vehicle, "soft_iron", 1e-4)
    yield from vary(vehicle, "hard_iron", 1.0)
    for name, mass in vehicle.mass.items():
        for field, step in (("moment", 1e-3), ("volume", 1e-5), ("at", 1e-5)):
            for up, down, width in vary(mass, field, step):
                yield (
                    msgspec.structs.replace(vehicle, mass=vehicle.mass | {name: up}),
                    msgspec.structs.replace(vehicle, mass=vehicle.mass | {name: down}),
                    width,
                )
