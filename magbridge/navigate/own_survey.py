r"""Localisation without a map: the track is bent to where the field that it met repeats itself.

.. math:: y_i = f(x_i + d(t_i)) + b(t_i) + e_i

d is the error of dead reckoning, b that of the calibration, f a Gaussian field in place whose size and
length the data choose: localisation and mapping at once, as 'MagSLAM' (Lee & Canciani 2020), by a
Rao-Blackwellised sampler: f is integrated out, and particles follow the posterior of d as the track goes on
(:mod:`.particles`). One crossing leaves a curve of drifts that agree with it, and a drift as large as the
field's length several: no single track with a Gaussian sigma describes that, the particles' spread does.
Where the field says nothing they stay where dead reckoning has them.

The likelihood of a drift d(t) is

.. math:: \log p(y | d) = -\tfrac12 y^T K^{-1} y - \tfrac12 \log|K| + \text{const},

.. math:: K_{ij} = s^2 k(|x_i + d_i - x_j - d_j| / \ell) + \beta_{ij} + R_{ij}

The Gaussian field (Rasmussen & Williams 2006, eq. 2.30; gradient eq. 5.9) has the size s and the length l;
its covariance k is Matérn's of smoothness 5/2 (eq. 4.17).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
import xarray as xr
from msgspec import structs
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.diagnostics import Diagnostic
from magbridge.errors import FormatError
from magbridge.field.geodesy import offset, separation
from magbridge.logs.deployment import deployment as made
from magbridge.navigate.batch import COLUMN_UNITS, MOTIONS, columns_of, first_position, motion_of, samples_of
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.findings import reference_track, with_errors
from magbridge.navigate.model import Block, Collector, transition
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.particles import sample

__all__ = ["OwnField", "drift_functions", "localise", "own_bound"]

BLOCK_LENGTH_M, MIN_BLOCKS_PER_LOG, MAX_TRACK_BLOCKS = 60.0, 100.0, 400
"""Limits of a block: its length, m, and the number of blocks that a log has at least. Of more than the last
number, every second or third block is used."""
MIN_TRACK_BLOCKS = 12
"""Blocks."""
STAGE_COUNT, PARTICLE_COUNT = 10, 80
"""Parts in which the track is processed, and number of tracks (particles)."""
MIN_LOST_FRACTION = 0.49
"""Fraction of the blocks from which on a track can be lost."""
MAX_NOISE_RATIO = 1.5
"""Noise over the calibration's from which on field and track contradict each other."""
MAX_IMPROVED_RATIO = 0.85
"""Of dead reckoning's sigma: less is worth saying."""


@dataclass(frozen=True, eq=False)
class _PosteriorTracks:
    """The tracks that agree with the field: their errors (k, n, 2), m.

    `typical` (q,) is the track nearest to the mean; `scales` (3,) are the median amplitude, length and noise.
    Tracks that differ by more than the field's length agree with it at different repetitions, most of which
    so few particles miss. Then `lost` is set, and the errors are those of dead reckoning alone.
    """

    moved: FloatArray
    typical: FloatArray
    scales: FloatArray
    lost: bool

    @classmethod
    def from_particles(cls, field: OwnField, u: FloatArray) -> _PosteriorTracks:
        """Return the tracks of the particles u (k, q)."""
        moved = field.moved(u)
        nearest = int(((moved - moved.mean(axis=0)) ** 2).sum(axis=(1, 2)).argmin())
        lost = _lost(field, u)
        scales = np.median(field.scales(u), axis=0)
        return cls(_unaided(field) if lost else moved, u[nearest], scales, lost)


def _lost(field: OwnField, u: FloatArray, count: int | None = None) -> bool:
    """Return True if tracks u (k, q) differ by more than the field's length over the first `count` blocks.

    Then more blocks do not bring them together: the first half decides.
    """
    if count is not None and count < MIN_LOST_FRACTION * len(field.time):
        return False
    # Spread of the tracks, RMS over the particles, against the median length of the field.
    apart = np.sqrt(field.moved(u)[:, :count].var(axis=0).sum(axis=1))
    return bool(np.median(apart) > np.median(field.scales(u), axis=0)[1])


def localise(
    deployment: xr.Dataset,
    options: NavigationOptions | None = None,
    *,
    start: tuple[float, float] | None = None,
) -> xr.Dataset:
    """Return the track that the field along it gives, without a map: arguments as :func:`~.batch.navigate`.

    It is on ``time`` of the blocks: position with covariance, ``north east`` from the dead-reckoned one,
    ``unaided_sigma`` of dead reckoning alone, anomaly and that of the field found; where the log has a better
    position, ``error_*`` and ``bound_sigma``, the smallest (:func:`own_bound`). Attributes: ``findings``,
    ``motion``, ``reference_track``.

    FormatError: no total field, no motion, no start, or no usable sample.
    """
    source = str(deployment.attrs.get("source", "deployment"))
    options = options or NavigationOptions()
    motion = motion_of(deployment, source)
    origin = start if start is not None else first_position(deployment, source)
    # 1. Average the samples to blocks along the dead-reckoned track.
    # 2. Sample the posterior of drift and field (particles).
    # 3. Mean and covariance over the particles; bound and errors where the truth is known.
    blocks, step = _blocks(deployment, options, motion, origin, source)
    rows = np.array(blocks)
    field = OwnField(blocks, np.stack(separation(*origin, rows[:, 1], rows[:, 2]), axis=1), options)
    counts = [len(blocks) * stage // STAGE_COUNT for stage in range(1, STAGE_COUNT + 1)]
    with threadpool_limits(1, "blas"):
        u = sample(field.log_likelihood, field.q, counts, PARTICLE_COUNT, partial(_lost, field))
        found = _PosteriorTracks.from_particles(field, u)
        known = reference_track(deployment, frozenset(MOTIONS[motion]))
        result = with_errors(_dataset(field, found, options, origin, rows[:, 7]), known)
        if known is not None:
            result = with_bound(result, field, found.moved.mean(axis=0), found.typical)
    attrs = {"source": source, "map": "none: its own survey", "motion": motion}
    return result.assign_attrs(
        attrs | {"findings": "\n".join(finding.text for finding in _findings(result, field, found, step))}
    )


def _unaided(field: OwnField) -> FloatArray:
    """Return errors (4 r, n, 2), m, whose mean is zero and whose covariance is dead reckoning's."""
    one = np.sqrt((4 * field.r - 1) / 2.0) * field.drift.T
    north = np.stack([one, np.zeros_like(one)], axis=2)
    return np.concatenate([north, -north, north[..., ::-1], -north[..., ::-1]])


def _blocks(
    deployment: xr.Dataset, options: NavigationOptions, motion: str, start: tuple[float, float], source: str
) -> tuple[list[Block], int]:
    """Return the blocks, and of how many each is one."""
    time, field, sigma = samples_of(deployment, source)
    moves = columns_of(deployment, MOTIONS[motion] | {"depth": "depth"})
    interval = max(options.interval, float(time[-1] - time[0]) / MIN_BLOCKS_PER_LOG)
    collector = Collector(structs.replace(options, interval=interval), BLOCK_LENGTH_M)
    reckoning, found = DeadReckoning(), []
    reckoning.place(*start)
    for i, t in enumerate(time.tolist()):
        reckoning.telemetry(t, {name: float(values[i]) for name, values in moves.items()})
        if np.isfinite(field[i]) and np.isfinite(sigma[i]):
            found.append(collector.add(round(t * 1e6), reckoning, float(field[i]), float(sigma[i])))
    whole = [one for one in (*found, collector.flush()) if one is not None]
    if len(whole) < MIN_TRACK_BLOCKS:
        raise FormatError(source, "expected samples of the total field at known times: too few are usable")
    step = ceil(len(whole) / MAX_TRACK_BLOCKS)
    return whole[::step], step


def _dataset(
    field: OwnField,
    found: _PosteriorTracks,
    options: NavigationOptions,
    origin: tuple[float, float],
    depth: FloatArray,
) -> xr.Dataset:
    """Return mean and covariance over the tracks, and the field that a typical one finds."""
    moved = found.moved.mean(axis=0)
    # Sample covariance over the particles for each block.
    off = found.moved - moved
    C = np.einsum("kni,knj->nij", off, off) / (len(off) - 1)
    place = field.place + moved
    latitude, longitude = offset(*origin, place[:, 0], place[:, 1])
    there = field.moved(found.typical)
    # Posterior mean of the field, y - R K^-1 y: the anomaly without the noise.
    K, R = field.covariance(field.place + there, found.typical)
    y = field.anomaly - field.mean - (field.slope * there).sum(axis=1)
    alone = np.sqrt(2.0 * (field.drift**2).sum(axis=1))
    sigma = np.sqrt(C[:, 0, 0] + C[:, 1, 1])
    good = (found.scales[2] < MAX_NOISE_RATIO) & (sigma < options.sigma_limit)
    columns = {
        "latitude": latitude, "longitude": longitude, "smoothed_latitude": latitude,
        "smoothed_longitude": longitude, "depth": depth, "covariance_nn": C[:, 0, 0],
        "covariance_ne": C[:, 0, 1], "covariance_ee": C[:, 1, 1],
        "smoothed_sigma_north": np.sqrt(C[:, 0, 0]), "smoothed_sigma_east": np.sqrt(C[:, 1, 1]),
        "north": moved[:, 0], "east": moved[:, 1],
        "unaided_sigma": alone, "anomaly": field.anomaly,
        "map_anomaly": field.mean + y - R * np.linalg.solve(K, y), "valid": good.astype(float),
    }  # fmt: skip
    return made("track", field.time, columns, COLUMN_UNITS | {"unaided_sigma": "m"})


def _findings(
    result: xr.Dataset, field: OwnField, found: _PosteriorTracks, step: int
) -> Iterator[Diagnostic]:
    """Yield statements on how much the field improved the track."""
    sigma = np.sqrt((result["covariance_nn"] + result["covariance_ee"]).to_numpy())
    alone = result["unaided_sigma"].to_numpy()
    size, length, noise = found.scales.tolist()
    reached = {"amplitude_nT": size, "length_m": length}
    for name, values in (("", sigma), ("alone_", alone)):
        reached |= {f"{name}median_m": float(np.median(values)), f"{name}last_m": float(values[-1])}
    yield Diagnostic("own_track", reached)
    if "bound_sigma" in result:
        best = float((result["bound_sigma"] ** 2).mean()) ** 0.5
        yield Diagnostic("own_track.bound", {"bound_m": best})
    if noise >= MAX_NOISE_RATIO:
        yield Diagnostic("own_track.contradiction", {"noise_ratio": noise})
    if length < field.shortest:
        thinned = f" (every {step}th is used)" if step > 1 else ""
        values = {"length_m": length, "apart_m": field.shortest / 4.0, "thinned": thinned}
        yield Diagnostic("own_track.too_short", values)
    if found.lost:
        yield Diagnostic("own_track.lost")
    elif np.median(alone) > length:
        yield Diagnostic("own_track.ambiguous")
    elif np.median(sigma) > MAX_IMPROVED_RATIO * np.median(alone):
        yield Diagnostic("own_track.little")


FIELD_AMPLITUDE_NT, AMPLITUDE_SPREAD = 50.0, np.log(4.0)
"""nT of the crustal field, and the 1-sigma of its logarithm: sea floor and land by airborne surveys."""
LENGTH_SPREAD, NOISE_SPREAD = np.log(6.0), np.log(1.3)
"""1-sigma of the logarithm of the length, and of the noise over what the calibration claims."""
MIN_LENGTH_SPACINGS, MIN_EXTENT_LENGTHS = 4.0, 2.5
"""The shortest length expected, over the distance of neighbours; the longest, over the track's extent."""
LEVEL_SCATTERS = 10.0
"""The level's 1-sigma, over the scatter of the measured field: it is not known."""
COVARIANCE_TIMES, MAX_FUNCTIONS, NEGLIGIBLE_VARIANCE_FRACTION = 240, 48, 1e-4
"""Times at which a drift's covariance is taken, its functions at most, and the share they may leave out."""
MAX_PRIOR_SIGMAS = 8.0
"""Sigmas of its prior beyond which no size, length or noise is tried."""
IMPOSSIBLE_LOG_LIKELIHOOD = -1e300
"""Log likelihood of an impossible track."""


def drift_functions(time: FloatArray, options: NavigationOptions) -> FloatArray:
    """Return functions (n, r), m, whose sum with weights N(0, 1) is the error of dead reckoning on one axis.

    `time` (n,) is in s. They are Karhunen-Loeve's: eigenvectors of the covariance that the state of
    :mod:`.model` has, scaled by the root of their eigenvalues.
    """
    # Covariance C(t_j, t_k) of the position error on a coarse grid of times, from the transition of position
    # and current: P(t_k) propagated forward to t_j.
    knots = np.linspace(time[0], max(time[-1], time[0] + 1.0), min(COVARIANCE_TIMES, max(len(time), 2)))
    F, Q = (one[np.ix_((0, 2), (0, 2))] for one in transition(options, knots[1] - knots[0], 0.0))
    P = np.diag([options.start_sigma, options.current_sigma]) ** 2
    C = np.zeros((len(knots), len(knots)))
    for k in range(len(knots)):
        later = P.copy()
        for j in range(k, len(knots)):
            C[j, k] = C[k, j] = later[0, 0]
            later = F @ later
        P = F @ P @ F.T + Q
    # Karhunen-Loeve: leading eigenvectors, scaled by the root of their eigenvalues.
    values, vectors = np.linalg.eigh(C)
    order = np.argsort(values)[::-1][:MAX_FUNCTIONS]
    kept = order[values[order] > NEGLIGIBLE_VARIANCE_FRACTION * values.max()]
    functions = vectors[:, kept] * np.sqrt(values[kept])
    return np.stack([np.interp(time, knots, one) for one in functions.T], axis=1)


class OwnField:
    """Blocks along a dead-reckoned track at `place` (n, 2), m, and the likelihood of what they measured.

    The unknown is u (q,), N(0, 1) each beforehand: the weights of the functions `drift` (n, r), m, north (r,)
    and east (r,), and the logarithms of the field's size, its length and the noise over their spread.
    """

    def __init__(self, blocks: list[Block], place: FloatArray, options: NavigationOptions) -> None:
        rows = np.array(blocks)
        self.time, self.place = rows[:, 0] * 1e-6, place
        self.anomaly, self.variance, self.slope = rows[:, 3], rows[:, 4], rows[:, 5:7]
        self.drift = drift_functions(self.time, options)
        self.r = self.drift.shape[1]
        self.q = 2 * self.r + 3
        self.mean = float(np.median(self.anomaly))
        step = float(np.median(np.linalg.norm(np.diff(place, axis=0), axis=1)))
        extent = float(np.hypot(*np.ptp(place, axis=0)))
        self.shortest = MIN_LENGTH_SPACINGS * max(step, 1.0)
        self._middle = float(np.sqrt(self.shortest * max(extent / MIN_EXTENT_LENGTHS, 1.5 * self.shortest)))
        # The calibration's error (exponential in time) and an unknown level.
        apart = np.abs(self.time[:, None] - self.time) / options.bias_time
        self._other = (
            options.bias_sigma**2 * np.exp(-apart) + (LEVEL_SCATTERS * float(self.anomaly.std())) ** 2
        )

    def moved(self, u: FloatArray) -> FloatArray:
        """Return the error of dead reckoning (n, 2), m, of u (q,); (k, n, 2) of several, (k, q)."""
        by = np.stack([u[..., : self.r], u[..., self.r : 2 * self.r]], axis=-1)
        return np.asarray(self.drift @ by)

    def scales(self, u: FloatArray) -> FloatArray:
        """Return the field's size, nT, its length, m, and the noise over the claimed one: (3,) or (k, 3)."""
        at_zero = np.array([FIELD_AMPLITUDE_NT, self._middle, 1.0])
        return np.asarray(at_zero * np.exp(u[..., -3:] * (AMPLITUDE_SPREAD, LENGTH_SPREAD, NOISE_SPREAD)))

    def log_likelihood(self, u: FloatArray, count: int) -> tuple[float, FloatArray]:
        """Return log p of the first `count` blocks, up to a constant, and its gradient by u (q,)."""
        gradient = np.zeros(self.q)
        if np.abs(u[-3:]).max() > MAX_PRIOR_SIGMAS:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        n = slice(0, count)
        size, length, noise = self.scales(u)
        d, W = self.moved(u)[n], self.drift[n]
        x, y = self.place[n] + d, self.anomaly[n] - self.mean - (self.slope[n] * d).sum(axis=1)
        squared, k, h, K, R = self._covariance(x, size, length, noise)
        # log p = -y' K^-1 y / 2 - log |L| with K = L L'.
        L, info = dpotrf(K.T, lower=1)
        if info:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        # alpha = K^-1 y; d log p / dK = (alpha alpha' - K^-1) / 2 (Rasmussen & Williams 2006, eq. 5.9).
        alpha = dpotrs(L, y, lower=1)[0]
        value = -0.5 * float(y @ alpha) - float(np.log(L.diagonal()).sum())
        inverse = np.tril(dpotri(L, lower=1)[0])
        G = np.outer(alpha, alpha) - inverse - np.tril(inverse, -1).T  # twice the slope by K
        # Chain rule: dK/dx through the distance, dK/d(log amplitude), dK/d(log length), dK/d(log noise).
        Gh = G * h
        steep = (size / length) ** 2
        by_place = steep * (Gh.sum(axis=1)[:, None] * x - Gh @ x) + self.slope[n] * alpha[:, None]
        gradient[: 2 * self.r] = (W.T @ by_place).T.ravel()
        gradient[-3] = size * size * float((G * k).sum()) * AMPLITUDE_SPREAD
        gradient[-2] = -0.5 * steep * float((Gh * squared).sum()) * LENGTH_SPREAD
        gradient[-1] = float(G.diagonal() @ R) * NOISE_SPREAD
        return value, gradient

    def covariance(self, place: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return K (n, n), nT², with the blocks at places (n, 2), m, and its part R (n,) that is noise."""
        _, _, _, K, R = self._covariance(place, *self.scales(u).tolist())
        return K, R

    def slopes(self, place: FloatArray, u: FloatArray) -> FloatArray:
        """Return the slopes (n, 2), nT/m, of the field that the blocks show if they are at places (n, 2), m.

        Notes
        -----
        The mean, ``∂k(x_i, x) K^-1 y`` (Rasmussen & Williams 2006, eq. 2.25 and section 9.4).
        """
        size, length, noise = self.scales(u)
        _, _, h, K, _ = self._covariance(place, size, length, noise)
        y = self.anomaly - self.mean - (self.slope * (place - self.place)).sum(axis=1)
        weight = (size / length) ** 2 * h * np.linalg.solve(K, y)
        return np.asarray(weight.sum(axis=1)[:, None] * place - weight @ place)

    def _covariance(self, x: FloatArray, size: float, length: float, noise: float) -> tuple[FloatArray, ...]:
        """Return ``|x_i - x_j|²``, k and h (n, n) of it, K (n, n), and R (n,)."""
        squared = (x[:, None, 0] - x[:, 0]) ** 2 + (x[:, None, 1] - x[:, 1]) ** 2
        # Matern 5/2 in a = sqrt(5) r / l, and h = (dk/dr) l^2 / r
        a = np.sqrt(5.0 * squared) / length
        falling = np.exp(-a)
        k, h = (1.0 + a + a * a / 3.0) * falling, -(5.0 / 3.0) * (1.0 + a) * falling
        K = size * size * k + self._other[: len(x), : len(x)]
        R = self.variance[: len(x)] * noise**2
        K.flat[:: len(x) + 1] += R
        return squared, k, h, K, R


def own_bound(field: OwnField, place: FloatArray, slopes: FloatArray, typical: FloatArray) -> FloatArray:
    """Return the smallest covariance (n, 2, 2), m², that any estimator of the drift could reach.

    `place` (m) and `slopes` (nT/m), (n, 2), are the true places and the field's slopes there; blocks where
    one is NaN carry no information. Size, length and noise are those of `typical` (q,).

    Notes
    -----
    Field and drift are linearised at the truth, jointly Gaussian; with the field integrated out the posterior
    Cramér-Rao bound of the drift's weights is ``(I + G' K^-1 G)^-1``, G the slopes times the drift's
    functions (Tichavský, Muravchik & Nehorai 1998, eq. 21, for one batch). The field's covariance is taken
    as known.
    """
    whole = np.asarray(np.isfinite(np.hstack([place, slopes])).all(axis=1))
    K = field.covariance(np.where(whole[:, None], place, 0.0), typical)[0][np.ix_(whole, whole)]
    # G: change of the measured anomaly by each weight of the drift's functions.
    felt = slopes[whole] + field.slope[whole]
    W = field.drift
    G = np.hstack([felt[:, :1] * W[whole], felt[:, 1:] * W[whole]])
    P = np.linalg.inv(np.eye(G.shape[1]) + G.T @ np.linalg.solve(K, G))
    return np.asarray(np.einsum("nr,arbs,ns->nab", W, P.reshape(2, field.r, 2, field.r), W))


def with_bound(result: xr.Dataset, field: OwnField, moved: FloatArray, typical: FloatArray) -> xr.Dataset:
    """Add the smallest error possible, m, to a track that is `moved` (n, 2), m, and whose error is known."""
    error = np.stack([result["error_north"], result["error_east"]], axis=1)
    true = field.place + moved - error
    whole = np.isfinite(true).all(axis=1)
    slopes = field.slopes(np.where(whole[:, None], true, field.place), typical)
    P = own_bound(field, true, slopes, typical)
    about = {"units": "m", "long_name": "smallest possible position error (DRMS)"}
    return result.assign(bound_sigma=("time", np.sqrt(np.trace(P, axis1=1, axis2=2)), about))
