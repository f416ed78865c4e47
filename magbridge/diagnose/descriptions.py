"""Free descriptions: columns that model structure of any kind in a residual, without a physical cause.

Arguments are series of the log's n samples, (n,) or (n, 3). Results are :mod:`.columns`, (m, k) for m rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import (
    ChannelEffect,
    ClockEffect,
    LegendreEffect,
    PathEffect,
    PlayEffect,
    RateEffect,
    ResponseEffect,
    lagged,
    play,
    powers,
)
from magbridge.calibration.terms import Effect
from magbridge.diagnose.causes.timing import field_rates, mass_rates
from magbridge.diagnose.columns import Candidate, Columns, effect_columns, size_of
from magbridge.diagnose.joint import Joint
from magbridge.diagnose.packets import packets, passage
from magbridge.diagnose.problem import Problem, rates, row_blocks

BEND = 32
"""Order of the polynomials of an axis' response, enough to follow a converter's coarsest steps."""
PLAYS = (0.3, 0.8)
"""Widths of the play operators that model hysteresis in a channel, in half ranges of the channel."""
HULL_LAGS_S = (0.0, 300.0, 1000.0, 3000.0, 10000.0)
"""Lags of processes in a hull, s: heat flow, seeping water, relaxing stress."""
SWAYS = (0.0, 10.0, 30.0)
"""Lags with which a loose or towed object follows a turn, s."""
SKIN = (5.0, 20.0)
"""Depths over which effects of the surface (light, heat, waves) decay, m."""
REPEATED = 8
"""Number of half waves per dive in a signal that every dive repeats."""
ZERO = (500.0, 1000.0, 2000.0)
"""Widths of errors near the zero reading of an axis, nT."""
SLIDING_TILT_SINES = (0.0, 0.1, 0.2)
"""Sines of the tilt at which a loose object in the hull starts to slide."""
BODY, EARTH = 24, 48
"""Number of half waves per log in slow curves: along each body axis, and along the field."""


def spectra(count: int, axes: int) -> tuple[tuple[str, FloatArray], ...]:
    """Return kinds of slow curve with the prior widths, nT, of `count` half waves along each of `axes`.

    The widths are those of an exponential correlation: the k-th half wave has ``10 / sqrt(1 + (k / k_0)^2)``,
    with k_0 the corner of the kind.
    """
    k = np.repeat(np.arange(1, count + 1), axes)
    corners = {"drift": 1.0, "switching": 8.0}
    return tuple((kind, 10.0 / np.sqrt(1.0 + (k / corner) ** 2)) for kind, corner in corners.items())


def direction(body: Columns) -> Columns:
    """Return monomials of order 1 to 4 of the field's direction in the body, that of `body` (m, 3)."""
    exponents = [(i, j, d - i - j) for d in (1, 2, 3, 4) for i in range(d + 1) for j in range(d + 1 - i)]

    def columns(rows: slice) -> FloatArray:
        part = body(rows)
        part = (part / np.linalg.norm(part, axis=1)[:, None]).T
        table = np.stack([np.ones(part.shape), *powers(part, 4)])
        return np.stack([table[i, 0] * table[j, 1] * table[k, 2] for i, j, k in exponents]).T

    return columns


def response(reading: FloatArray, jacobian: Columns) -> Columns:
    """Return errors of each axis that are Chebyshev polynomials of its own `reading` (n, 3), nT.

    `jacobian` gives the change (m, 3) of the residual per nT in each axis.
    """
    axes = [_scaled(axis) for axis in reading.T]

    def columns(rows: slice) -> FloatArray:
        x = np.clip([axis(rows) for axis in axes], -1.0, 1.0)
        turning = x + 1j * np.sqrt(1.0 - x**2)  # cos k theta = T_k(x), with x = cos theta
        waves = np.stack(powers(turning, BEND), 1).real
        return np.asarray((jacobian(rows).T[:, None] * waves).reshape(3 * BEND, -1).T)

    return columns


def bends() -> tuple[tuple[str, FloatArray], ...]:
    """Return prior widths (3 BEND,) of the polynomials of :func:`response`, by smoothness."""
    k = np.arange(1.0, BEND + 1.0)
    return tuple(
        ("broadband", np.tile(30.0 / width, 3)) for width in (np.sqrt(1.0 + (k / 8.0) ** 2), k**2, k**3)
    )


def crossing(reading: FloatArray, jacobian: Columns) -> Columns:
    """Return errors of each axis near its zero reading (Hermite functions); arguments as :func:`response`."""

    def columns(rows: slice) -> FloatArray:
        x = reading[rows].T[:, None] / np.array(ZERO)[:, None]
        odd = x * np.exp(-0.5 * x * x)
        return np.asarray((jacobian(rows).T[:, None] * odd).reshape(3 * len(ZERO), -1).T)

    return columns


def curve(values: FloatArray) -> Columns:
    """Return the powers 1 to 4 of a channel's `values` (n,), scaled to -1 to 1, less their means."""
    y = _scaled(values)
    return _centred(lambda rows: np.stack(powers(y(rows), 4)).T, len(values))


def hysteresis(values: FloatArray) -> Columns:
    """Return hysteresis of a channel (n,): branches of a narrow and a wide play, and direction of motion."""
    scaled = _scaled(values)
    y = scaled(slice(None))
    # Branches v^k - x^k of the play operator at two widths, and the direction of motion
    plays = [play(y, width).astype(np.float32) for width in PLAYS]
    change = np.diff(y, prepend=y[0])
    way = np.where(np.abs(change) > 1e-3, np.sign(change), 0.0).astype(np.int8)

    def columns(rows: slice) -> FloatArray:
        v, w = scaled(rows), way[rows]
        branches = [np.stack(powers(x[rows].astype(float), 3)) - np.stack(powers(v, 3)) for x in plays]
        return np.concatenate([*branches, [w, w * v]]).T

    return _centred(columns, len(values))


def delayed(time: FloatArray, values: FloatArray) -> Columns:
    """Return a channel (n,) with each of :data:`HULL_LAGS_S`; their sums imitate any smooth response."""
    return _centred(_followed(time, _scaled(values)(slice(None))[None], HULL_LAGS_S), len(values))


def swings(time: FloatArray, rate: FloatArray) -> Columns:
    """Return the rate of turn (n,) and its square, each with each of the lags :data:`SWAYS`."""
    low, high = np.quantile(rate, (0.001, 0.999))  # a jump of the telemetry is not a turn
    y = np.clip(rate, low, high) / max(high, -low, 1e-12)
    swung = _followed(time, y[None], SWAYS)
    return _centred(lambda rows: np.reshape(powers(swung(rows).T, 2), (2 * len(SWAYS), -1)).T, len(rate))


def near_surface(time: FloatArray, depth: FloatArray) -> Columns:
    """Return surface effects that decay exponentially with depth (n,), m, each with each hull lag."""
    near = np.exp(-(depth - depth.min()) / np.array(SKIN)[:, None])
    return _centred(_followed(time, near, HULL_LAGS_S[:-1]), len(depth))


def repeated(problem: Problem) -> Columns:
    """Return half waves of the time since the start of each dive, in units of a usual dive's duration."""
    dive, time = problem.survey.dive, problem.survey.time
    # Phase in the dive, 0 to 1, of the usual duration
    start = np.flatnonzero(np.diff(dive, prepend=dive[0] - 1))
    since = time - np.repeat(time[start], np.diff([*start, len(dive)]))
    # the median: a long last dive must not stretch the others
    usual = max(float(np.median([since[end - 1] for end in [*start[1:], len(dive)]])), 1.0)
    u = np.minimum(since / usual, 1.0)
    return _centred(lambda rows: np.stack(powers(np.exp(1j * np.pi * u[rows]), REPEATED)).real.T, len(u))


def lower_end(tilt: FloatArray) -> Columns:
    """Return the end of the hull, -1 or 1, at which a loose object lies, by the sine of the `tilt` (n,)."""
    place = np.arange(len(tilt))
    sides = []
    for slope in SLIDING_TILT_SINES:
        last = np.maximum.accumulate(np.where(np.abs(tilt) > slope, place, 0))
        sides.append(np.sign(tilt[last]).astype(np.int8))
    return _centred(lambda rows: np.stack([side[rows] for side in sides]).T.astype(float), len(tilt))


def _followed(time: FloatArray, values: FloatArray, lags: Sequence[float]) -> Columns:
    """Return each series of `values` (k, n) with each of the `lags`, s."""
    followed = np.stack([lagged(time, y, lag).astype(np.float32) for y in values for lag in lags])
    return lambda rows: followed[:, rows].T.astype(float)


def _centred(columns: Columns, n: int) -> Columns:
    mean = sum(columns(rows).sum(axis=0) for rows in row_blocks(n)) / n
    return lambda rows: columns(rows) - mean


def _scaled(values: FloatArray) -> Columns:
    """Return a function of m rows: `values` (n,) scaled linearly to the range -1 to 1, (m,)."""
    low, span = values.min(), max(float(np.ptp(values)), 1e-12)
    return lambda rows: np.asarray(2.0 * (values[rows] - low) / span - 1.0)


def _is(*kinds: type[Effect]) -> Callable[[Candidate], bool]:
    """Return a function that returns True if a candidate has an effect of one of these classes."""
    return lambda candidate: any(isinstance(effect, kinds) for effect in candidate.effects)


class Description(NamedTuple):
    """A free description: columns with their prior, and the properties that make it an alternative."""

    columns: Columns
    """Changes of the residual, nT, per unit of each coefficient."""
    widths: tuple[tuple[str, FloatArray], ...]
    """Alternatives: kind, and prior widths (1-sigma) of the coefficients up to a common factor."""
    channel: str | None = None
    """Telemetry channel of which the columns are functions; None if there is none."""
    look_elsewhere: float = 1.0
    """Number of independent descriptions from which this one was chosen."""
    period: float | None = None
    """Period of a tone, s."""
    holds: Callable[[Candidate], bool] = _is()
    """Function that returns True if the columns contain a candidate's own regressors."""
    turned: bool = False
    """True if the columns are the same functions along each axis of the body."""
    remembers: bool = False
    """True if the columns depend on the channel's past (hysteresis), not only on its value."""
    scales: bool = False
    """True if the effect is proportional to each axis' reading: a change of sensitivity."""
    wider: bool = False
    """True if the columns are much more general than a cause that they contain."""

    def covers(self, model: Sequence[Candidate]) -> bool:
        """Return True if the description contains a cause of `model`; if it is `wider`, all causes."""
        heat = "scale" if self.scales else "offset"
        same = [
            self.holds(candidate)
            or (
                candidate.channel is not None
                and candidate.channel == self.channel
                and _is(PlayEffect)(candidate) == self.remembers
                and _heat(candidate) in (heat, None)
            )
            for candidate in model
        ]
        return any(same) and (all(same) or not self.wider)


def _heat(candidate: Candidate) -> Literal["offset", "scale"] | None:
    """Return whether a candidate's lagged temperature effect is of offset or scale; None without one."""
    soaked = (e for e in candidate.effects if isinstance(e, ChannelEffect) and e.stages > 1)
    return next((effect.on for effect in soaked), None)


def _bends(candidate: Candidate) -> bool:
    return any(isinstance(effect, ResponseEffect) and effect.power for effect in candidate.effects)


def descriptions(problem: Problem, fit: Joint) -> list[Description]:
    """Return all free descriptions of a log, with passages and packets in the residual of a `fit`."""
    return [
        *_in_time(problem, fit),
        *_of_reading(problem),
        *_of_channels(problem),
        *_of_attitude(problem),
    ]


def _in_time(problem: Problem, fit: Joint) -> list[Description]:
    """Return slow curves, a constant, a passage, a signal that dives repeat, and wave packets."""
    time, dive, field = problem.survey.time, problem.survey.dive, problem.reference_jacobian
    constant = field * ~problem.survey.learned
    turn = np.exp(1j * np.pi * (time - time[0]) / max(float(time[-1] - time[0]), 1.0))

    def waves(count: int) -> Columns:
        return lambda rows: np.stack(powers(turn[rows], count)).real.T

    passing, times = passage(problem, fit)
    listed = [
        _in_body(problem, waves(BODY))._replace(widths=spectra(BODY, 3)),
        Description(
            lambda rows: field[rows, None] * waves(EARTH)(rows),
            (*spectra(EARTH, 1), ("transient", np.full(EARTH, 10.0))),
        ),
        _described(
            lambda rows: constant[rows, None], "drift", 1.0, holds=lambda one: one.about == "constant"
        ),
        _described(passing, "transient", look_elsewhere=times),
    ]
    if np.ptp(dive):
        listed.append(_in_body(problem, repeated(problem)))
    rings = packets(problem, fit)
    if rings is not None:
        count, period = rings.look_elsewhere, rings.period
        listed.append(_described(rings.columns, "tone", look_elsewhere=count, period=period))
    return listed


def _of_reading(problem: Problem) -> list[Description]:
    """Return functions of the field's direction, rates and axis readings, and a delay of the masses."""
    rate = field_rates(problem)

    def body(rows: slice) -> FloatArray:
        return -problem.jacobian[rows, 6:]

    listed = [
        _described(direction(body), holds=_bends, wider=True),
        _in_body(problem, lambda rows: rate[:, rows].T, width=1.0, holds=_is(RateEffect)),
        Description(response(problem.reading, body), bends(), holds=_bends, wider=True),
        _described(crossing(problem.reading, body)),
    ]
    if problem.calibration.parameters:
        late = effect_columns(problem, ClockEffect(), mass_rates(problem))
        listed.append(_described(late, width=1.0, holds=_is(ClockEffect)))
    return listed


def _of_channels(problem: Problem) -> list[Description]:
    """Return for each channel functions of its value, of its past (hysteresis), and of lagged values."""
    masses = {parameter.name for parameter in problem.calibration.parameters}
    survey, listed = problem.survey, []

    def moves(candidate: Candidate) -> bool:
        """Return True if a candidate changes the effect of a mass of the calibration."""
        return any(
            isinstance(e, LegendreEffect) or (isinstance(e, PathEffect) and e.channel in masses)
            for e in candidate.effects
        )

    for name, channel in survey.channels.items():
        if name in survey.still:
            continue
        now, before = curve(channel.values), hysteresis(channel.values)
        late, warm = delayed(survey.time, channel.values), "temperature" in channel.kinds
        listed += [
            _in_body(problem, now, channel=name, holds=moves if name in masses else _is()),
            _in_body(problem, before, channel=name, remembers=True),
            _in_body(problem, late, channel=name, holds=lambda c, w=warm: w and _heat(c) == "offset"),
            _in_body(
                problem, late, scales=True, channel=name, holds=lambda c, w=warm: w and _heat(c) == "scale"
            ),
        ]
    if "depth" in survey.channels and "depth" not in survey.still:
        listed.append(_in_body(problem, near_surface(survey.time, survey.channels["depth"].values)))
    return listed


def _of_attitude(problem: Problem) -> list[Description]:
    """Return functions of pitch, roll and rate of turn, for objects that hang, slide or swing in the hull."""
    if problem.survey.attitude is None:
        return []
    listed = []
    time, angles = problem.survey.time, np.unwrap(np.radians(problem.survey.attitude.T))
    roll, pitch = angles[:2]
    for down in (-np.sin(pitch), np.sin(roll) * np.cos(pitch)):
        listed += [_in_body(problem, curve(down)), _in_body(problem, lower_end(down), kind="switching")]
    rate = rates(problem.survey, angles)
    return [*listed, *(_in_body(problem, swings(time, one)) for one in rate)]


def _in_body(
    problem: Problem, basis: Columns, *, scales: bool = False, kind: str = "broadband", **more: Any
) -> Description:
    """Return a description by `basis` along each body axis, times the axis' reading with `scales`."""

    def columns(rows: slice) -> FloatArray:
        part = basis(rows)
        axes = -problem.jacobian.T[6:, rows]
        if scales:
            axes = axes * problem.reading.T[:, rows] / problem.calibration.reference.field
        return (part.T[:, None] * axes).reshape(-1, len(part)).T

    return _described(columns, kind, turned=True, scales=scales, **more)


def _described(columns: Columns, kind: str = "broadband", width: float = 30.0, **more: Any) -> Description:
    """Return a description whose coefficients have one common prior `width`."""
    return Description(columns, ((kind, np.full(size_of(columns), width)),), **more)
