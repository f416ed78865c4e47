r"""Localisation without a map: the track is bent to where the field that it met repeats itself.

.. math:: y_i = f(x_i + d(t_i)) + b(t_i) + e_i

d is the error of dead reckoning, b that of the calibration, f a Gaussian field in place whose size and length
the evidence chooses (:mod:`magbridge.calibration.fitting.field_search`): localisation and mapping at once, as
'MagSLAM' (Lee & Canciani 2020), by a batch smoother instead of particles. It is Gauss-Newton on d with f
eliminated. The track is taken in stages: what a stage has settled is where the next one starts from, so that
at each return only the drift since the last one is unknown. Where a drift is as large as the field's length,
more than one way to bend the track may be a maximum; several are kept from stage to stage, each with its
evidence, and what they differ by is part of the covariance.

What it reaches is bounded by the track itself: where that does not come back to a place, or comes back
farther off than the field's length, the field says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from msgspec import structs
from scipy.sparse import csr_array, diags_array
from threadpoolctl import threadpool_limits

from magbridge.arrays import FloatArray
from magbridge.calibration.fitting.crossings import courses, crossed
from magbridge.calibration.fitting.evidence import maximise
from magbridge.calibration.fitting.field_search import (
    Choice,
    Weighed,
    choose,
    ladder,
    nodes_for,
    refined,
)
from magbridge.calibration.fitting.joint import Linear, Reduced, Sums, add_up, eliminate
from magbridge.calibration.fitting.latent import NOTHING, Group, with_groups
from magbridge.calibration.fitting.solve import covariance_of
from magbridge.errors import FormatError
from magbridge.field.geodesy import offset, separation
from magbridge.field.place.matern import Matern
from magbridge.logs.deployment import deployment as made
from magbridge.navigate.batch import MOTIONS, UNITS, columns_of, first_position, motion_of, samples_of
from magbridge.navigate.collect import Collector
from magbridge.navigate.deadreckoning import DeadReckoning
from magbridge.navigate.model import Block, transition
from magbridge.navigate.options import Options
from magbridge.navigate.reference_track import reference_track, with_errors

__all__ = ["localise"]

STEP, BLOCKS = 40.0, 6_000
"""m that a block of samples covers at most, and blocks of a log at most."""
KNOTS, WAVES, LEFT_OUT = 240, 48, 1e-4
"""Times at which a drift's covariance is taken, its functions at most, and the share they may leave out."""
STAGES, TURNS = 6, 8
"""Parts in which the track is taken in, and rounds of Gauss-Newton at most after each."""
TRIES, KEPT = 10, 5
"""Other tracks that are tried in every stage, and those that are kept."""
APART, UNLIKELY = 0.1, 12.0
"""Of the field's length: tracks nearer to each other are one. Nats by which one is worse that is dropped."""
FARTHEST = 0.35
"""Of the field's length: a round bends the track by no more."""
STILL = 0.02
"""Of the field's length: a round that bends it by less is the last."""
CONTRADICTED = 1.5
"""Residual over its sigma from which on field and track contradict each other."""
GAINED, MET = 0.85, 0.5
"""Of dead reckoning's sigma: less is worth saying. Of the field's length: places as near as that are one."""


@dataclass(frozen=True, eq=False)
class _Drift:
    """Functions of time (n, r) whose sum with independent weights of sigma 1 is a random process."""

    waves: FloatArray

    @classmethod
    def of(cls, time: FloatArray, options: Options, start: float) -> _Drift:
        """Return the error of dead reckoning along one axis, m, at times (n,), s: Karhunen-Loeve's functions.

        `start` is its 1-sigma at the beginning, m.
        """
        knots = np.linspace(time[0], max(time[-1], time[0] + 1.0), min(KNOTS, max(len(time), 2)))
        F, Q = (one[np.ix_((0, 2), (0, 2))] for one in transition(options, knots[1] - knots[0], 0.0))
        P = np.diag([start, options.current_sigma]) ** 2
        C = np.zeros((len(knots), len(knots)))
        for k in range(len(knots)):
            later = P.copy()
            for j in range(k, len(knots)):
                C[j, k] = C[k, j] = later[0, 0]
                later = F @ later
            P = F @ P @ F.T + Q
        values, vectors = np.linalg.eigh(C)
        order = np.argsort(values)[::-1][:WAVES]
        kept = order[values[order] > LEFT_OUT * values.max()]
        functions = vectors[:, kept] * np.sqrt(values[kept])
        return cls(np.stack([np.interp(time, knots, one) for one in functions.T], axis=1))


class _Track:
    """Blocks along a dead-reckoned track, and where it is bent to."""

    def __init__(self, blocks: list[Block], origin: tuple[float, float], options: Options) -> None:
        rows = np.array(blocks)
        self.time = rows[:, 0] * 1e-6
        self.reckoned = np.stack(separation(*origin, rows[:, 1], rows[:, 2]), axis=1)
        self.anomaly, self.sigma, self.slope = rows[:, 3], np.sqrt(rows[:, 4]), rows[:, 5:7]
        drift = _Drift.of(self.time, options, options.start_sigma).waves
        self.drift, self.r = drift, drift.shape[1]
        self.mean = float(np.median(self.anomaly))
        since = (self.time - self.time[0]) / options.bias_time
        bias = np.stack([np.ones(len(since)), since - since.mean()], axis=1)
        nothing = np.zeros_like(drift)
        self.groups = (
            Group("bias", bias, np.array([1.0, 1.0]), max(options.bias_sigma, 1e-3), np.log(2.0)),
            Group("position north", nothing, np.ones(self.r), 1.0),
            Group("position east", nothing, np.ones(self.r), 1.0),
        )
        self.bias = bias
        self.family = with_groups(NOTHING, self.groups)

    def bent(self, z: FloatArray) -> FloatArray:
        """Return the positions (n, 2), m, with the unknowns z."""
        return self.reckoned + self.moved(z)

    def moved(self, z: FloatArray) -> FloatArray:
        """Return the error of dead reckoning (n, 2), m."""
        return np.stack([self.drift @ z[2 : 2 + self.r], self.drift @ z[2 + self.r :]], axis=1)

    def sums(self, field: Matern, z: FloatArray, w: FloatArray | None, count: int) -> Sums:
        """Return the sums of the first `count` blocks, linearised about z (q,) and w (nodes,).

        Without w the track stays where it is with z.
        """
        part = slice(0, count)
        place, here = self.bent(z)[part], self.moved(z)[part]
        slopes = np.zeros((count, 2))
        if w is not None:
            slopes = np.stack([one @ w for one in field.nodes.slopes(place)], axis=1)
        y = -(self.anomaly[part] - self.mean) - (slopes * here).sum(axis=1)
        felt = slopes + self.slope[part]
        D = [self.bias[part], felt[:, :1] * self.drift[part], felt[:, 1:] * self.drift[part]]
        weight = 1.0 / self.sigma[part]
        B = csr_array(diags_array(weight) @ field.basis(place))
        return add_up([Linear(np.column_stack([y, *D]) * weight[:, None], B, np.zeros(count, bool))])


@dataclass(frozen=True, eq=False)
class _Way:
    """One way to bend the track: z, its covariance, the field's coefficients (nodes,) with their choice.

    `sigma` is the residual's size over what it should be, `score` the log evidence.
    """

    z: FloatArray
    covariance: FloatArray
    choice: Choice
    w: FloatArray
    sigma: float
    score: float


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
        ``unaided_sigma`` of dead reckoning alone, anomaly and that of the field found, ``error_*`` where the
        log has a better position. Attributes: ``findings``, ``motion``, ``reference_track``.

    Raises
    ------
    FormatError
        No total field, no motion, no start, or no usable sample.
    """
    source = str(deployment.attrs.get("source", "deployment"))
    options = options or Options()
    motion = motion_of(deployment, source)
    origin = start if start is not None else first_position(deployment, source)
    blocks = _blocks(deployment, options, motion, origin, source)
    track = _Track(blocks, origin, options)
    with threadpool_limits(1, "blas"):
        ways = _settled(track)
    known = reference_track(deployment, frozenset(MOTIONS[motion]))
    result = with_errors(_dataset(track, ways, origin, np.array([one.depth for one in blocks])), known)
    attrs = {"source": source, "map": "none: its own survey", "motion": motion}
    return result.assign_attrs(attrs | {"findings": "\n".join(_findings(result, track, ways))})


def _blocks(
    deployment: xr.Dataset, options: Options, motion: str, start: tuple[float, float], source: str
) -> list[Block]:
    time, field, sigma = samples_of(deployment, source)
    moves = columns_of(deployment, MOTIONS[motion] | {"depth": "depth"})
    interval = max(options.interval, float(time[-1] - time[0]) / BLOCKS)
    collector = Collector(structs.replace(options, interval=interval), max(STEP, interval))
    reckoning, found = DeadReckoning(), []
    reckoning.place(*start)
    for i, t in enumerate(time.tolist()):
        reckoning.telemetry(t, {name: float(values[i]) for name, values in moves.items()})
        if np.isfinite(field[i]) and np.isfinite(sigma[i]):
            found.append(collector.add(round(t * 1e6), reckoning, float(field[i]), float(sigma[i])))
    whole = [one for one in (*found, collector.flush()) if one is not None]
    if len(whole) < 2 * STAGES:
        raise FormatError(source, "expected samples of the total field at known times: too few are usable")
    return whole


def _settled(track: _Track) -> list[_Way]:
    """Take the track in stage by stage; return the ways that are left, the likeliest first."""
    middle = float(np.median(ladder(track.reckoned)))
    weighed = Weighed(track.family, track.family.centre, 1.0, middle)
    rng = np.random.default_rng(0)
    ways: list[_Way] = []
    for stage in range(1, STAGES + 1):
        count = len(track.time) * stage // STAGES
        z = ways[0].z if ways else np.zeros(2 + 2 * track.r)
        place = track.bent(z)[:count]

        def sums_of(field: Matern, count: int = count, z: FloatArray = z) -> Sums:
            return track.sums(field, z, None, count)

        if ways:
            choice = refined(sums_of, place, _around(ways[0].choice, place), weighed)
        else:
            choice = choose(sums_of, place, weighed, 20.0, harmonic=False, rho=0.0, effort=0.6)
        starts = [way.z for way in ways] or [z]
        if ways:
            starts += [_drawn(ways, rng) for _ in range(TRIES)]
        ways = _distinct(track, [_bent(track, choice, count, start) for start in starts], count)
    return ways


def _drawn(ways: list[_Way], rng: np.random.Generator) -> FloatArray:
    """Return another start (q,) about one of the ways, by its uncertainty."""
    way = ways[int(rng.integers(len(ways)))]
    return np.asarray(rng.multivariate_normal(way.z, way.covariance, method="eigh"))


def _distinct(track: _Track, ways: list[_Way], count: int) -> list[_Way]:
    """Return the likeliest ways that are not each other's, the best first."""
    kept: list[_Way] = []
    for way in sorted(ways, key=lambda one: -one.score):
        near = APART * way.choice.field.length
        if len(kept) == KEPT or way.score < (kept[0].score if kept else -np.inf) - UNLIKELY:
            break
        if all(np.abs(track.moved(way.z - one.z)[:count]).max() > near for one in kept):
            kept.append(way)
    return kept


def _around(choice: Choice, place: FloatArray) -> Choice:
    """Return the choice with nodes about places (n, 2), m, and white noise."""
    field = replace(choice.field, nodes=nodes_for(place, choice.field.length))
    return replace(choice, field=field, rho=0.0)


def _bent(track: _Track, choice: Choice, count: int, z: FloatArray) -> _Way:
    """Bend the track with the first `count` blocks from z (q,) until it stands still."""
    for turn in range(TURNS + 1):
        choice = _around(choice, track.bent(z)[:count])
        w, here, bending = _linearised(track, choice, count, z)
        widths = maximise(bending.quadratic, track.family, track.family.centre, 1.0)
        scale2, prior = max(widths.sigma, 1.0) ** 2, track.family.at(widths.eta).precision
        precision = bending.quadratic.H / scale2 + prior
        step = np.linalg.solve(precision, bending.quadratic.b / scale2) - z
        far = float(np.linalg.norm(track.moved(step)[:count], axis=1).max())
        if far < STILL * choice.field.length or turn == TURNS:
            break
        z = z + min(1.0, FARTHEST * choice.field.length / far) * step
    q, covariance = here.quadratic, covariance_of(precision)
    cost = (q.c_0 - 2.0 * q.b @ z + z @ q.H @ z) / scale2 + z @ prior @ z
    room = np.linalg.slogdet(prior @ covariance)[1]
    score = here.log_evidence - 0.5 * float(cost) - q.n * float(np.log(scale2)) / 2.0 + 0.5 * float(room)
    return _Way(z, covariance, choice, w, widths.sigma, score)


def _linearised(
    track: _Track, choice: Choice, count: int, z: FloatArray
) -> tuple[FloatArray, Reduced, Reduced]:
    """Return the field (nodes,) that the first `count` blocks show where the track is, and what bends it."""
    here = eliminate(track.sums(choice.field, z, None, count), choice.field, choice.ratio, 0.0)
    w = here.field(z)
    return w, here, eliminate(track.sums(choice.field, z, w, count), choice.field, choice.ratio, 0.0)


def _dataset(track: _Track, ways: list[_Way], origin: tuple[float, float], depth: FloatArray) -> xr.Dataset:
    """Return mean and covariance over the ways, and the field that the likeliest one finds."""
    best, r = ways[0], track.r
    weights = np.exp([way.score - best.score for way in ways])
    weights /= weights.sum()
    moved = sum((p * track.moved(way.z) for p, way in zip(weights, ways, strict=True)), np.zeros((1, 2)))
    axes = slice(2, 2 + r), slice(2 + r, None)
    C = np.zeros((len(depth), 2, 2))
    for p, way in zip(weights, ways, strict=True):
        off = track.moved(way.z) - moved
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            within = np.einsum("ni,ij,nj->n", track.drift, way.covariance[axes[i], axes[j]], track.drift)
            C[:, i, j] += p * (within + off[:, i] * off[:, j])
    place = track.reckoned + moved
    latitude, longitude = offset(*origin, place[:, 0], place[:, 1])
    bias = track.bias @ best.z[:2]
    there = track.bent(best.z)
    found = track.mean + best.choice.field.basis(there) @ best.w + bias
    alone = np.sqrt(2.0 * (track.drift**2).sum(axis=1))
    columns = {
        "latitude": latitude, "longitude": longitude, "smoothed_latitude": latitude,
        "smoothed_longitude": longitude, "depth": depth, "covariance_nn": C[:, 0, 0],
        "covariance_ne": C[:, 0, 1], "covariance_ee": C[:, 1, 1],
        "smoothed_sigma_north": np.sqrt(C[:, 0, 0]), "smoothed_sigma_east": np.sqrt(C[:, 1, 1]),
        "north": moved[:, 0], "east": moved[:, 1],
        "unaided_sigma": alone, "anomaly": track.anomaly,
        "map_anomaly": np.where(best.choice.field.nodes.inside(there), found, np.nan), "bias": bias,
        "valid": ((best.sigma < CONTRADICTED) & (alone < 2.0**0.5 * best.choice.field.length)).astype(float),
    }  # fmt: skip
    return made("track", track.time, columns, UNITS | {"unaided_sigma": "m"})


def _findings(result: xr.Dataset, track: _Track, ways: list[_Way]) -> Iterator[str]:
    """Say what the field was worth."""
    answer = ways[0]
    sigma = np.sqrt((result["covariance_nn"] + result["covariance_ee"]).to_numpy())
    alone = result["unaided_sigma"].to_numpy()
    field = answer.choice.field
    yield (
        f"field of {answer.choice.ratio * answer.sigma:.0f} nT over {field.length:.0f} m; position 1-sigma "
        f"{np.median(sigma):.0f} m in the median, {sigma[-1]:.0f} m at the end; dead reckoning alone "
        f"{np.median(alone):.0f} and {alone[-1]:.0f} m"
    )
    if len(ways) > 1:
        yield f"{len(ways)} ways to bend the track agree with the field: the sigma counts what they differ by"
    if answer.sigma >= CONTRADICTED:
        yield (
            f"field and track contradict each other (residuals of {answer.sigma:.1f} sigma): the track came "
            "back farther off than the field's length, or the calibration is not good; do not use it"
        )
    if not result["valid"].all():
        yield (
            "dead reckoning alone may be off by more than the field's length: a track bent to the wrong "
            "place would look as good, and its sigma would not show it; positions there are not valid"
        )
    met = sum(crossed(*courses(track.bent(answer.z)), MET * field.length))
    if not met or np.median(sigma) > GAINED * np.median(alone):
        yield (
            "the field adds little to dead reckoning: the track has to come back to places it has met, "
            "before it has drifted by more than the field's length"
        )
