r"""Localisation without a map: the track is bent to where the field that it met repeats itself.

.. math:: y_i = f(x_i + d(t_i)) + b(t_i) + e_i

d is the error of dead reckoning, b that of the calibration, f a Gaussian field in place whose size and length
the data choose: localisation and mapping at once, as 'MagSLAM' (Lee & Canciani 2020), by a Rao-Blackwellised
sampler: f is integrated out (:mod:`.own_field`), and particles follow the posterior of d as the track goes on
(:mod:`.particles`). One crossing leaves a curve of drifts that agree with it, and a drift as large as the
field's length several: no single track with a Gaussian sigma describes that, the particles' spread does.
Where the field says nothing they stay where dead reckoning has them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
import xarray as xr
from msgspec import structs
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.errors import FormatError
from magbridge.field.geodesy import offset, separation
from magbridge.logs.deployment import deployment as made
from magbridge.navigate.batch import COLUMN_UNITS, MOTIONS, columns_of, first_position, motion_of, samples_of
from magbridge.navigate.collect import Collector
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block
from magbridge.navigate.options import Options
from magbridge.navigate.own_bound import with_bound
from magbridge.navigate.own_field import COVARIANCE_KINDS, OwnField
from magbridge.navigate.particles import Particles, sample
from magbridge.navigate.reference_track import reference_track, with_errors

__all__ = ["localise"]

STEP, LASTS, BLOCKS = 60.0, 100.0, 400
"""m that a block of samples covers at most, the share of the log that it lasts at most is one in so many, and
the number of blocks at most: of more, every second or third is used."""
MIN_BLOCKS = 12
"""Blocks."""
STAGES, PARTICLES = 10, 80
"""Parts in which the track is processed, and number of tracks (particles)."""
MIN_LOST_FRACTION = 0.49
"""Share of the blocks from which on a track can be lost."""
CONTRADICTED = 1.5
"""Noise over the calibration's from which on field and track contradict each other."""
GAINED = 0.85
"""Of dead reckoning's sigma: less is worth saying."""


@dataclass(frozen=True, eq=False)
class _Found:
    """The tracks that agree with the field: their errors (k, n, 2), m, and the likeliest kind of field.

    `typical` (q,) is the track of that kind nearest to the mean; `scales` (3,) are the median amplitude,
    length and noise. Tracks that differ by more than the field's length agree with it at different
    repetitions, most of which so few particles miss. Then `lost` is set, and the errors are those of dead
    reckoning alone.
    """

    moved: FloatArray
    kind: int
    typical: FloatArray
    scales: FloatArray
    lost: bool

    @classmethod
    def of(cls, field: OwnField, particles: Particles) -> _Found:
        moved = field.moved(particles.u)
        kind = int(np.bincount(particles.kind, minlength=len(COVARIANCE_KINDS)).argmax())
        off = ((moved - moved.mean(axis=0)) ** 2).sum(axis=(1, 2))
        nearest = int(np.where(particles.kind == kind, off, np.inf).argmin())
        scales = np.median(field.scales(particles.u), axis=0)
        lost = _lost(field, particles.u)
        return cls(_unaided(field) if lost else moved, kind, particles.u[nearest], scales, lost)


def _lost(field: OwnField, u: FloatArray, count: int | None = None) -> bool:
    """Return True if tracks u (k, q) differ by more than the field's length over the first `count` blocks.

    Then more blocks do not bring them together: the first half decides.
    """
    if count is not None and count < MIN_LOST_FRACTION * len(field.time):
        return False
    apart = np.sqrt(field.moved(u)[:, :count].var(axis=0).sum(axis=1))
    return bool(np.median(apart) > np.median(field.scales(u), axis=0)[1])


def localise(
    deployment: xr.Dataset, options: Options | None = None, *, start: tuple[float, float] | None = None
) -> xr.Dataset:
    """Return the track that the field gives which the vehicle met itself.

    Parameters
    ----------
    deployment : Dataset
        As for :func:`~.batch.navigate`.
    options : Options, optional
        How well start, current and calibration are known.
    start : (latitude, longitude), optional
        deg; default the log's first position.

    Returns
    -------
    Dataset
        On ``time`` of the blocks: position with covariance, ``north east`` from the dead-reckoned one,
        ``unaided_sigma`` of dead reckoning alone, anomaly and that of the field found; where the log has a
        better position, ``error_*`` and ``bound_sigma``, the smallest (:func:`~.own_bound.own_bound`).
        Attributes: ``findings``, ``motion``, ``reference_track``.

    Raises
    ------
    FormatError
        No total field, no motion, no start, or no usable sample.
    """
    source = str(deployment.attrs.get("source", "deployment"))
    options = options or Options()
    motion = motion_of(deployment, source)
    origin = start if start is not None else first_position(deployment, source)
    blocks, step = _blocks(deployment, options, motion, origin, source)
    rows = np.array(blocks)
    field = OwnField(blocks, np.stack(separation(*origin, rows[:, 1], rows[:, 2]), axis=1), options)
    counts = [len(blocks) * stage // STAGES for stage in range(1, STAGES + 1)]
    with threadpool_limits(1, "blas"):
        particles = sample(
            field.log_likelihood, field.q, len(COVARIANCE_KINDS), counts, PARTICLES, partial(_lost, field)
        )
        found = _Found.of(field, particles)
        known = reference_track(deployment, frozenset(MOTIONS[motion]))
        result = with_errors(_dataset(field, found, options, origin, rows[:, 7]), known)
        if known is not None:
            result = with_bound(result, field, found.moved.mean(axis=0), found.typical, found.kind)
    attrs = {"source": source, "map": "none: its own survey", "motion": motion}
    return result.assign_attrs(attrs | {"findings": "\n".join(_findings(result, field, found, step))})


def _unaided(field: OwnField) -> FloatArray:
    """Return errors (4 r, n, 2), m, whose mean is zero and whose covariance is dead reckoning's."""
    one = np.sqrt((4 * field.r - 1) / 2.0) * field.drift.T
    north = np.stack([one, np.zeros_like(one)], axis=2)
    return np.concatenate([north, -north, north[..., ::-1], -north[..., ::-1]])


def _blocks(
    deployment: xr.Dataset, options: Options, motion: str, start: tuple[float, float], source: str
) -> tuple[list[Block], int]:
    """Return the blocks, and of how many each is one."""
    time, field, sigma = samples_of(deployment, source)
    moves = columns_of(deployment, MOTIONS[motion] | {"depth": "depth"})
    interval = max(options.interval, float(time[-1] - time[0]) / LASTS)
    collector = Collector(structs.replace(options, interval=interval), STEP)
    reckoning, found = DeadReckoning(), []
    reckoning.place(*start)
    for i, t in enumerate(time.tolist()):
        reckoning.telemetry(t, {name: float(values[i]) for name, values in moves.items()})
        if np.isfinite(field[i]) and np.isfinite(sigma[i]):
            found.append(collector.add(round(t * 1e6), reckoning, float(field[i]), float(sigma[i])))
    whole = [one for one in (*found, collector.flush()) if one is not None]
    if len(whole) < MIN_BLOCKS:
        raise FormatError(source, "expected samples of the total field at known times: too few are usable")
    step = ceil(len(whole) / BLOCKS)
    return whole[::step], step


def _dataset(
    field: OwnField, found: _Found, options: Options, origin: tuple[float, float], depth: FloatArray
) -> xr.Dataset:
    """Return mean and covariance over the tracks, and the field that a typical one finds."""
    moved = found.moved.mean(axis=0)
    off = found.moved - moved
    C = np.einsum("kni,knj->nij", off, off) / (len(off) - 1)
    place = field.place + moved
    latitude, longitude = offset(*origin, place[:, 0], place[:, 1])
    there = field.moved(found.typical)
    K, R = field.covariance(field.place + there, found.typical, found.kind)
    y = field.anomaly - field.mean - (field.slope * there).sum(axis=1)
    alone = np.sqrt(2.0 * (field.drift**2).sum(axis=1))
    sigma = np.sqrt(C[:, 0, 0] + C[:, 1, 1])
    good = (found.scales[2] < CONTRADICTED) & (sigma < options.sigma_limit)
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


def _findings(result: xr.Dataset, field: OwnField, found: _Found, step: int) -> Iterator[str]:
    """Yield sentences on how much the field improved the track."""
    sigma = np.sqrt((result["covariance_nn"] + result["covariance_ee"]).to_numpy())
    alone = result["unaided_sigma"].to_numpy()
    size, length, noise = found.scales.tolist()
    yield (
        f"field of {size:.0f} nT over {length:.0f} m; position 1-sigma {np.median(sigma):.0f} m in the "
        f"median, {sigma[-1]:.0f} m at the end; dead reckoning alone {np.median(alone):.0f} and "
        f"{alone[-1]:.0f} m"
    )
    if "bound_sigma" in result:
        best = float((result["bound_sigma"] ** 2).mean()) ** 0.5
        yield f"no estimator could be better than {best:.0f} m RMS here, with this track and this field"
    if noise >= CONTRADICTED:
        yield (
            f"field and track contradict each other (noise of {noise:.1f} times what the calibration "
            "claims): the calibration or the options for dead reckoning are not good; do not use it"
        )
    if length < field.shortest:
        apart = f"{field.shortest / 4.0:.0f} m apart"
        yield (
            f"the field changes over {length:.0f} m, and measurements are {apart}"
            + (f" (every {step}th is used)" if step > 1 else "")
            + ": it is hardly followed"
        )
    if found.lost:
        yield (
            "tracks that differ by more than the field's length agree with it equally well, and not all are "
            "known: this is dead reckoning alone"
        )
    elif np.median(alone) > length:
        yield (
            "dead reckoning may be off by more than the field's length: the track may be at another "
            "repetition of the field, which its sigma does not count; check it against a fix"
        )
    elif np.median(sigma) > GAINED * np.median(alone):
        yield (
            "the field adds little to dead reckoning: the track has to come back to places it has met, "
            "before it has drifted by more than the field's length"
        )
