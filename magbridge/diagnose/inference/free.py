"""Free descriptions: structure of any kind in a residual, without a name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.causes.regressors import powers
from magbridge.diagnose.causes.timing import field_rates
from magbridge.diagnose.compare.problem import Columns, Problem
from magbridge.diagnose.inference.joint import Joint

__all__ = ["Description", "descriptions"]

FloatArray = NDArray[np.float64]

BODY, EARTH = 24, 48
"""Half waves in a log of slow curves along the body's axes, and along the field."""
BEND = 10
"""Order of a channel's free response."""


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
    """

    columns: Columns
    widths: tuple[tuple[str, FloatArray], ...]
    channel: str | None = None
    trials: float = 1.0
    period: float | None = None
    holds: tuple[str, ...] = ()
    turned: bool = False

    def retells(self, model: Sequence[Candidate]) -> bool:
        """Say whether it is what a cause of `model` says, with more numbers."""
        return any(
            candidate.cause in self.holds or (candidate.channel and candidate.channel == self.channel)
            for candidate in model
        )


def descriptions(problem: Problem, fit: Joint, tone: Candidate | None = None) -> list[Description]:
    """List what structure of any kind is looked for with.

    Slow curves along each axis of the body and along the field, the loudest window of the log, the direction of the
    field, its rates of change, each channel's response, and a curve through each telemetry channel with the way that
    it goes and the side that it came from.
    """
    body = -problem.slopes[:, 6:]
    u = problem.survey.time - problem.survey.time[0]
    u = np.pi * u / max(float(u[-1]), 1.0)
    rates = field_rates(problem)

    def projected(basis: Columns) -> Columns:
        """Each function along each axis of the body."""

        def columns(rows: slice) -> FloatArray:
            part = basis(rows)
            return np.asarray((part[:, :, None] * body[rows, None, :]).reshape(len(part), -1))

        return columns

    def waves(count: int) -> Columns:
        return lambda rows: np.cos(u[rows, None] * np.arange(1, count + 1))

    listed = [
        Description(projected(waves(BODY)), _spectra(BODY, 3), turned=True),
        Description(
            lambda rows: problem.gain[rows, None] * waves(EARTH)(rows),
            (*_spectra(EARTH, 1), ("transient", np.full(EARTH, 10.0))),
        ),
        _window(problem, fit),
        _of("broadband", _direction(body), 25),
        _of("broadband", projected(lambda rows: rates[:, rows].T), 9, 1.0)._replace(
            holds=("eddy_current", "channel_skew"), turned=True
        ),
    ]
    listed += [
        Description(
            _response(problem.reading[:, axis], body[:, axis]), (("broadband", 30.0 / np.arange(1, BEND + 1)),)
        )
        for axis in range(3)
    ]  # fmt: skip
    listed += [
        _of("broadband", projected(_curve(channel.values)), 27, channel=name)._replace(turned=True)
        for name, channel in problem.survey.channels.items()
        if name not in problem.survey.still
    ]
    if tone is not None:
        width = (("tone", np.ones(tone.size)),)
        listed.append(Description(tone.columns, width, None, tone.trials, tone.shape["period"][0]))
    return listed


def _of(
    kind: str, columns: Columns, size: int, width: float = 30.0, channel: str | None = None
) -> Description:
    return Description(columns, ((kind, np.full(size, width)),), channel)


def _spectra(count: int, axes: int) -> tuple[tuple[str, FloatArray], ...]:
    """Widths of an exponential memory's half waves (a relaxation, a telegraph): ``1 / sqrt(1 + (k / k_0)^2)``."""
    k = np.repeat(np.arange(1, count + 1), axes)
    return tuple((kind, 10.0 / np.sqrt(1.0 + (k / corner) ** 2)) for kind, corner in (("drift", 1.0), ("transient", 8.0)))  # fmt: skip


def _window(problem: Problem, fit: Joint) -> Description:
    """Find the window in which the field is most surely off by a constant: all lengths, at every quarter of one."""
    n = len(problem)
    gain = fit.noise.filter(problem.gain[:, None])[:, 0]
    with_y, own = (np.append(0.0, np.cumsum(gain * x)) for x in (fit.noise.response(fit.left), gain))
    best, first, end, trials, length = 0.0, 0, 1, 0, 4
    while length <= max(n // 8, 4):
        starts = np.arange(0, n - length + 1, max(length // 4, 1))
        trials += starts.size
        z = np.abs(with_y[starts + length] - with_y[starts]) / np.sqrt(own[starts + length] - own[starts])
        at = int(np.argmax(z)) if starts.size else 0
        if starts.size and z[at] > best:
            best, first, end = float(z[at]), int(starts[at]), int(starts[at]) + length
        length = int(1.5 * length) + 1
    inside = np.zeros(n)
    inside[first:end] = 1.0
    columns: Columns = lambda rows: (problem.gain[rows] * inside[rows])[:, None]  # noqa: E731  (as the others)
    return _of("transient", columns, 1)._replace(trials=float(max(trials, 1)))


def _direction(body: FloatArray) -> Columns:
    """Cubic and quartic functions of the field's direction in the body."""
    unit = body / np.linalg.norm(body, axis=1)[:, None]
    exponents = [(i, j, d - i - j) for d in (3, 4) for i in range(d + 1) for j in range(d + 1 - i)]

    def columns(rows: slice) -> FloatArray:
        part = unit[rows].T
        table = np.concatenate([np.ones((1, *part.shape)), powers(part, 4)])
        return np.stack([table[i, 0] * table[j, 1] * table[k, 2] for i, j, k in exponents], axis=1)

    return columns


def _response(reading: FloatArray, slope: FloatArray) -> Columns:
    """One channel's error as any smooth function of its own reading: Chebyshev polynomials."""
    angle = np.arccos(np.clip(_scaled(reading), -1.0, 1.0))
    return lambda rows: slope[rows, None] * np.cos(angle[rows, None] * np.arange(1, BEND + 1))


def _curve(values: FloatArray) -> Columns:
    """Powers of a channel, and the way that it goes and the side that it came from, across its first powers."""
    y = _scaled(values)
    step = np.diff(y, prepend=y[0])
    way = np.where(np.abs(step) > 1e-3, np.sign(step), 0.0)
    last = np.maximum.accumulate(np.where(way != 0.0, np.arange(len(y)), 0))
    side = way[last]

    def columns(rows: slice) -> FloatArray:
        v, w, d = y[rows], way[rows], side[rows]
        one, two, three, four = powers(v, 4)
        return np.stack([one, two, three, four, d, d * one, d * two, w, w * one], axis=1)

    mean = columns(slice(None)).mean(axis=0)
    return lambda rows: columns(rows) - mean


def _scaled(values: FloatArray) -> FloatArray:
    return np.asarray(2.0 * (values - values.min()) / max(float(np.ptp(values)), 1e-12) - 1.0)
