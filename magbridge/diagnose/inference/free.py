"""Free descriptions: structure of any kind in a residual, without a name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.followers import ClockEffect
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.causes.regressors import play, powers
from magbridge.diagnose.causes.timing import field_rates, mass_rates
from magbridge.diagnose.compare.columns import Columns
from magbridge.diagnose.compare.problem import Problem, effect_columns
from magbridge.diagnose.inference.events import passage, step
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.packets import packets

__all__ = ["Description", "descriptions"]

FloatArray = NDArray[np.float64]

BODY, EARTH = 24, 48
"""Half waves in a log of slow curves along the body's axes, and along the field."""
REPEATED = 8
"""Half waves in a dive of what repeats itself with each."""
BEND = 32
"""Order of a channel's free response: as fine as a converter's coarsest steps."""
PLAYS = (0.3, 0.8)
"""Widths of a channel's memory, half of its range being one."""
SLOPES = (0.0, 0.1, 0.2)
"""Sines of the angles at which what lies loose in the hull slides."""


class Description(NamedTuple):
    """A description without a name.

    Attributes
    ----------
    columns : Columns
        What its numbers leave in the residual.
    widths : tuple of (str, array (k,))
        Kind, and the numbers' prior widths (1-sigma) up to a common factor; each is tried.
    channel : str or None
        The telemetry that it is a curve of.
    trials : float
        Independent descriptions that it was chosen from.
    period : float or None
        s, of a tone.
    holds : tuple of str
        Causes whose own regressors are among the columns.
    turned : bool
        The columns are functions along each of the body's axes.
    remembers : bool
        It is the past of the channel, not its value, that it follows.
    """

    columns: Columns
    widths: tuple[tuple[str, FloatArray], ...]
    channel: str | None = None
    trials: float = 1.0
    period: float | None = None
    holds: tuple[str, ...] = ()
    turned: bool = False
    remembers: bool = False

    def retells(self, model: Sequence[Candidate]) -> bool:
        """Say whether it is what a cause of `model` says, with more numbers."""
        return any(
            candidate.cause in self.holds
            or (
                candidate.channel is not None
                and candidate.channel == self.channel
                and (candidate.cause == "hysteresis") == self.remembers
            )
            for candidate in model
        )


def descriptions(problem: Problem, fit: Joint, tone: Candidate | None = None) -> list[Description]:
    """List what structure of any kind is looked for with.

    Slow curves along each axis of the body and along the field, and a constant along that; since when the offsets are
    others, what passed by, what rang for a while, and what each dive repeats; the direction of the field, its rates of
    change, the channels' response, one delay of everything; what hangs in the hull, and what lies loose at its lower end; of
    each telemetry channel a curve through its values, and its memory of where it was.
    """
    body = -problem.slopes[:, 6:]
    u = problem.survey.time - problem.survey.time[0]
    turning = np.exp(1j * np.pi * u / max(float(u[-1]), 1.0))
    rates, fresh = field_rates(problem), ~problem.survey.learned

    def projected(basis: Columns) -> Columns:
        """Each function along each axis of the body."""

        def columns(rows: slice) -> FloatArray:
            part = basis(rows)
            return (part.T[:, None] * body.T[:, rows]).reshape(-1, len(part)).T

        return columns

    def waves(count: int) -> Columns:
        return lambda rows: powers(turning[rows], count).real.T

    since, moments = step(problem, fit)
    passing, times = passage(problem, fit)
    listed = [
        Description(projected(waves(BODY)), _spectra(BODY, 3), turned=True),
        Description(
            lambda rows: problem.gain[rows, None] * waves(EARTH)(rows),
            (*_spectra(EARTH, 1), ("transient", np.full(EARTH, 10.0))),
        ),
        _of("drift", lambda rows: (problem.gain * fresh)[rows, None], 1, 1.0, holds=("reference_bias",)),
        _of("switching", since, 3, trials=moments, holds=("offset_step",)),
        _of("transient", passing, 3, trials=times),
        _of("broadband", _direction(body), 34),
        _of(
            "broadband", projected(lambda rows: rates[:, rows].T), 9, 1.0,
            holds=("eddy_current", "channel_skew"), turned=True,
        ),
        Description(_response(problem.reading, body), _bends()),
    ]  # fmt: skip
    own = {parameter.name for parameter in problem.calibration.parameters}
    if own:
        late = effect_columns(problem, ClockEffect(), mass_rates(problem))
        listed.append(_of("broadband", late, 1, 1.0, holds=("clock_offset", "filter_lag")))
    for name, channel in problem.survey.channels.items():
        if name not in problem.survey.still:
            held = ("actuator_order",) if name in own else ()
            curve, memory = projected(_curve(channel.values)), projected(_memory(channel.values))
            listed += [
                _of("broadband", curve, 12, channel=name, turned=True, holds=held),
                _of("broadband", memory, 24, channel=name, turned=True, remembers=True),
            ]
    if problem.survey.attitude is not None:
        roll, pitch = np.radians(problem.survey.attitude[:, :2].T)
        for down in (-np.sin(pitch), np.sin(roll) * np.cos(pitch)):
            listed += [
                _of("broadband", projected(_curve(down)), 12, turned=True),
                _of("switching", projected(_ends(down)), 3 * len(SLOPES), turned=True),
            ]
    dive = problem.survey.dive
    if np.ptp(dive):
        listed.append(_of("broadband", projected(_repeated(problem)), 3 * REPEATED, turned=True))
    rings = packets(problem, fit)
    if rings is not None:
        width = (("tone", np.full(2 * rings.number, 30.0)),)
        listed.append(Description(rings.columns, width, None, rings.trials, rings.period))
    if tone is not None:
        width = (("tone", np.ones(tone.size)),)
        listed.append(Description(tone.columns, width, None, tone.trials, tone.shape["period"][0]))
    return listed


def _of(kind: str, columns: Columns, size: int, width: float = 30.0, **more: Any) -> Description:
    return Description(columns, ((kind, np.full(size, width)),), **more)


def _spectra(count: int, axes: int) -> tuple[tuple[str, FloatArray], ...]:
    """Widths of an exponential memory's half waves (a relaxation, a telegraph): ``1 / sqrt(1 + (k / k_0)^2)``."""
    k = np.repeat(np.arange(1, count + 1), axes)
    return tuple((kind, 10.0 / np.sqrt(1.0 + (k / corner) ** 2)) for kind, corner in (("drift", 1.0), ("switching", 8.0)))  # fmt: skip


def _direction(body: FloatArray) -> Columns:
    """Functions up to quartic of the field's direction in the body."""
    unit = body / np.linalg.norm(body, axis=1)[:, None]
    exponents = [(i, j, d - i - j) for d in (1, 2, 3, 4) for i in range(d + 1) for j in range(d + 1 - i)]

    def columns(rows: slice) -> FloatArray:
        part = unit[rows].T
        table = np.concatenate([np.ones((1, *part.shape)), powers(part, 4)])
        return np.stack([table[i, 0] * table[j, 1] * table[k, 2] for i, j, k in exponents]).T

    return columns


def _response(reading: FloatArray, slopes: FloatArray) -> Columns:
    """Each channel's error as any smooth function of its own reading: Chebyshev polynomials."""
    x = np.clip([_scaled(channel) for channel in reading.T], -1.0, 1.0)
    turning = x + 1j * np.sqrt(1.0 - x**2)  # by the angle whose cosine is x

    def columns(rows: slice) -> FloatArray:
        waves = powers(turning[:, rows], BEND).real.swapaxes(0, 1)
        return (slopes.T[:, None, rows] * waves).reshape(3 * BEND, -1).T

    return columns


def _bends() -> tuple[tuple[str, FloatArray], ...]:
    """Widths of a response's polynomials: with steps, with a corner, or without."""
    k = np.arange(1.0, BEND + 1.0)
    return tuple(
        ("broadband", np.tile(30.0 / width, 3)) for width in (np.sqrt(1.0 + (k / 8.0) ** 2), k**2, k**3)
    )


def _curve(values: FloatArray) -> Columns:
    """Powers of a channel."""
    y = _scaled(values)
    return _centred(lambda rows: powers(y[rows], 4).T)


def _memory(values: FloatArray) -> Columns:
    """Return what a channel's past adds: curved branches, narrow and wide, and the way that it goes."""
    y = _scaled(values)
    plays = [play(y, width) for width in PLAYS]
    change = np.diff(y, prepend=y[0])
    way = np.where(np.abs(change) > 1e-3, np.sign(change), 0.0)

    def columns(rows: slice) -> FloatArray:
        v, w = y[rows], way[rows]
        branches = [powers(x[rows], 3) - powers(v, 3) for x in plays]
        return np.concatenate([*branches, [w, w * v]]).T

    return _centred(columns)


def _repeated(problem: Problem) -> Columns:
    """Return half waves in the course of a dive, the same in all."""
    dive, time = problem.survey.dive, problem.survey.time
    start = np.flatnonzero(np.diff(dive, prepend=dive[0] - 1))
    since = time - np.repeat(time[start], np.diff([*start, len(dive)]))
    # a long last one is no reason to stretch the others
    usual = max(float(np.median([since[end - 1] for end in [*start[1:], len(dive)]])), 1.0)
    u = np.minimum(since / usual, 1.0)
    turning = np.exp(1j * np.pi * u)
    return _centred(lambda rows: powers(turning[rows], REPEATED).real.T)


def _ends(down: FloatArray) -> Columns:
    """Return at which end of the hull lies what slides to the lower one, and sticks until it is tipped by so much."""
    place = np.arange(len(down))
    ends = []
    for slope in SLOPES:
        last = np.maximum.accumulate(np.where(np.abs(down) > slope, place, 0))
        ends.append(np.sign(down[last]))
    return _centred(lambda rows: np.stack([end[rows] for end in ends]).T)


def _centred(columns: Columns) -> Columns:
    mean = columns(slice(None)).mean(axis=0)
    return lambda rows: columns(rows) - mean


def _scaled(values: FloatArray) -> FloatArray:
    return np.asarray(2.0 * (values - values.min()) / max(float(np.ptp(values)), 1e-12) - 1.0)
