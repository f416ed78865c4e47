r"""Localisation without a map: estimate the track along which the measured field is consistent with itself.

.. math:: y_i = f(x_i + d(t_i)) + b(t_i) + e_i

d is the drift (the error of dead reckoning), b the error of the calibration, and f a Gaussian random field in
space, whose amplitude and correlation length the data determine. This is simultaneous localisation and
mapping, as 'MagSLAM' (Lee & Canciani 2020), by a Rao-Blackwellised sampler: f is integrated out, and
particles sample the posterior of d (:mod:`.particles`). One crossing of the track leaves a curve of possible
drifts; a drift as large as the correlation length leaves several curves. Particles represent such a
posterior, a Gaussian would not. Where the field carries no information, particles follow dead reckoning.

The likelihood of a drift d(t) is

.. math:: \log p(y | d) = -\tfrac12 y^T K^{-1} y - \tfrac12 \log|K| + \text{const},

.. math:: K_{ij} = s^2 k(|x_i + d_i - x_j - d_j| / \ell) + \beta_{ij} + R_{ij}

The Gaussian field (Rasmussen & Williams 2006, eq. 2.30; gradient eq. 5.9) has the amplitude s and the
correlation length l; its covariance k is Matérn's of smoothness 5/2 (eq. 4.17).
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
"""Length of a block, m; smallest number of blocks in a log; largest number of blocks that are used. If there
are more, only every second or third block is used."""
MIN_TRACK_BLOCKS = 12
"""Smallest number of blocks from which a track is estimated."""
STAGE_COUNT, PARTICLE_COUNT = 10, 80
"""Number of stages in which the sampler adds the blocks, and number of particles (tracks)."""
MIN_LOST_FRACTION = 0.49
"""Fraction of the blocks that must be processed before a track can be lost."""
MAX_NOISE_RATIO = 1.5
"""Smallest estimated noise, over the calibration's, with which field and track contradict each other."""
MAX_IMPROVED_RATIO = 0.85
"""Largest position sigma over dead reckoning's with which the field counts as an improvement."""


@dataclass(frozen=True, eq=False)
class _PosteriorTracks:
    """Sample of tracks from the posterior: `moved` (k, n, 2), their errors of dead reckoning, m.

    `typical` (q,) is the particle nearest to the mean; `scales` (3,) are the median amplitude (nT),
    correlation length (m) and noise ratio. `lost` is True if the tracks differ by more than the correlation
    length. So few particles then miss most of the possible tracks, and `moved` is dead reckoning's prior.
    """

    moved: FloatArray
    typical: FloatArray
    scales: FloatArray
    lost: bool

    @classmethod
    def from_particles(cls, field: OwnField, u: FloatArray) -> _PosteriorTracks:
        """Return the sample of tracks that the particles u (k, q) represent."""
        moved = field.moved(u)
        nearest = int(((moved - moved.mean(axis=0)) ** 2).sum(axis=(1, 2)).argmin())
        lost = _lost(field, u)
        scales = np.median(field.scales(u), axis=0)
        return cls(_unaided(field) if lost else moved, u[nearest], scales, lost)


def _lost(field: OwnField, u: FloatArray, count: int | None = None) -> bool:
    """Return True if tracks u (k, q) differ by more than the field's length over the first `count` blocks.

    Before half of the blocks, return False. More blocks do not bring tracks together that differ then.
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
    """Estimate the track of a log from its total field without a map; arguments as :func:`~.batch.navigate`.

    The dataset is on ``time`` of the blocks. It holds the position with its covariance; ``north east``, the
    offset from the dead-reckoned position; ``unaided_sigma`` of dead reckoning alone; ``anomaly`` and
    ``map_anomaly``, measured and estimated. If the log has a better position, ``error_*`` and ``bound_sigma``
    are the errors and the smallest possible error (:func:`own_bound`), m. Attributes: ``findings``,
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
    """Return errors (4 r, n, 2), m, of dead reckoning alone: zero mean, and the prior covariance."""
    one = np.sqrt((4 * field.r - 1) / 2.0) * field.drift.T
    north = np.stack([one, np.zeros_like(one)], axis=2)
    return np.concatenate([north, -north, north[..., ::-1], -north[..., ::-1]])


def _blocks(
    deployment: xr.Dataset, options: NavigationOptions, motion: str, start: tuple[float, float], source: str
) -> tuple[list[Block], int]:
    """Return the blocks, of which every `step`-th is used, and that `step`."""
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
    """Return a dataset of mean and covariance over the tracks, and the field along the typical track."""
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
    """Yield diagnostics on how much the field improved the track."""
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
"""Prior median of the crustal field's amplitude, nT, and the 1-sigma of its logarithm (airborne surveys)."""
LENGTH_SPREAD, NOISE_SPREAD = np.log(6.0), np.log(1.3)
"""Prior 1-sigmas of the logarithms of the correlation length and of the noise over the calibration's."""
MIN_LENGTH_SPACINGS, MIN_EXTENT_LENGTHS = 4.0, 2.5
"""Shortest correlation length in spacings of blocks; track's extent in the longest correlation length."""
LEVEL_SCATTERS = 10.0
"""Prior 1-sigma of the constant bias, over the scatter of the measured field; practically unknown."""
COVARIANCE_TIMES, MAX_FUNCTIONS, NEGLIGIBLE_VARIANCE_FRACTION = 240, 48, 1e-4
"""Number of times of the drift's covariance; most drift functions; smallest eigenvalue over the largest."""
MAX_PRIOR_SIGMAS = 8.0
"""Largest deviation of log amplitude, log length or log noise that is tried, in sigmas of its prior."""
IMPOSSIBLE_LOG_LIKELIHOOD = -1e300
"""Log likelihood of an impossible track."""


def drift_functions(time: FloatArray, options: NavigationOptions) -> FloatArray:
    """Return functions (n, r), m, whose sum with weights N(0, 1) is the error of dead reckoning on one axis.

    `time` (n,) is in s. It is a Karhunen-Loeve expansion: eigenvectors of the position error's covariance by
    :mod:`.model`, scaled by the root of their eigenvalues.
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
    """Likelihood of the anomalies measured in blocks along a track dead-reckoned at `place` (n, 2), m.

    The unknown vector u (q,) has the prior N(0, 1). It holds the weights of the functions `drift` (n, r), m,
    north (r,) and east (r,), and scaled logarithms of the field's amplitude, correlation length and noise.
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
        """Return the error of dead reckoning (n, 2), m, for the unknowns u (q,); (k, n, 2) for u (k, q)."""
        by = np.stack([u[..., : self.r], u[..., self.r : 2 * self.r]], axis=-1)
        return np.asarray(self.drift @ by)

    def scales(self, u: FloatArray) -> FloatArray:
        """Return amplitude (nT) and correlation length (m) of the field, and noise ratio: (3,) or (k, 3)."""
        at_zero = np.array([FIELD_AMPLITUDE_NT, self._middle, 1.0])
        return np.asarray(at_zero * np.exp(u[..., -3:] * (AMPLITUDE_SPREAD, LENGTH_SPREAD, NOISE_SPREAD)))

    def log_likelihood(self, u: FloatArray, count: int) -> tuple[float, FloatArray]:
        """Return the log likelihood of the first `count` blocks, up to a constant, and its gradient (q,)."""
        gradient = np.zeros(self.q)
        if np.abs(u[-3:]).max() > MAX_PRIOR_SIGMAS:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        n = slice(0, count)
        size, length, noise = self.scales(u)
        d, W = self.moved(u)[n], self.drift[n]
        x, y = self.place[n] + d, self.anomaly[n] - self.mean - (self.slope[n] * d).sum(axis=1)
        squared, k, h, K, R = self._covariance(x, size, length, noise)
        # log p = -y' K^-1 y / 2 - log |L| with K = L L'.
        L, info = dpotrf(K.T, lower=1, overwrite_a=1)
        if info:
            return IMPOSSIBLE_LOG_LIKELIHOOD, gradient
        # alpha = K^-1 y; d log p / dK = (alpha alpha' - K^-1) / 2 (Rasmussen & Williams 2006, eq. 5.9).
        alpha = dpotrs(L, y, lower=1)[0]
        value = -0.5 * float(y @ alpha) - float(np.log(L.diagonal()).sum())
        lower = dpotri(L, lower=1, overwrite_c=1)[0]  # with zeros above
        inverse = lower + lower.T
        inverse.flat[:: count + 1] = lower.diagonal()
        G = alpha[:, None] * alpha - inverse  # twice the slope by K
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
        """Return the covariance K (n, n), nT², of blocks at places (n, 2), m, and its noise part R (n,)."""
        _, _, _, K, R = self._covariance(place, *self.scales(u).tolist())
        return K, R

    def slopes(self, place: FloatArray, u: FloatArray) -> FloatArray:
        """Return the slopes (n, 2), nT/m, of the field estimated from the blocks at places (n, 2), m.

        Notes
        -----
        Posterior mean ``∂k(x_i, x) K^-1 y`` (Rasmussen & Williams 2006, eq. 2.25 and section 9.4).
        """
        size, length, noise = self.scales(u)
        _, _, h, K, _ = self._covariance(place, size, length, noise)
        y = self.anomaly - self.mean - (self.slope * (place - self.place)).sum(axis=1)
        weight = (size / length) ** 2 * h * np.linalg.solve(K, y)
        return np.asarray(weight.sum(axis=1)[:, None] * place - weight @ place)

    def _covariance(self, x: FloatArray, size: float, length: float, noise: float) -> tuple[FloatArray, ...]:
        """Return the squared distances of x (n, 2), k and h at them, K (all (n, n)), and the noise R (n,)."""
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

    `place` (m) and `slopes` (nT/m), (n, 2), are the true places and the field's slopes there. Blocks with a
    NaN in either carry no information. Amplitude, length and noise are those of the particle `typical` (q,).

    Notes
    -----
    Linearised at the truth, field and drift are jointly Gaussian. With the field integrated out, the bound of
    the drift's weights is ``(I + G' K^-1 G)^-1``. G is the product of the slopes and the drift's functions
    (posterior Cramér-Rao bound: Tichavský, Muravchik & Nehorai 1998, eq. 21, for one batch). The field's
    covariance is assumed known.
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
    """Return `result` with ``bound_sigma``, the smallest possible position error, m.

    `moved` (n, 2), m, is the track's offset from dead reckoning; `result` holds its known error.
    """
    error = np.stack([result["error_north"], result["error_east"]], axis=1)
    true = field.place + moved - error
    whole = np.isfinite(true).all(axis=1)
    slopes = field.slopes(np.where(whole[:, None], true, field.place), typical)
    P = own_bound(field, true, slopes, typical)
    about = {"units": "m", "long_name": "smallest possible position error (DRMS)"}
    return result.assign(bound_sigma=("time", np.sqrt(np.trace(P, axis1=1, axis2=2)), about))
