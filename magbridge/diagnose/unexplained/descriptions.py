"""Free descriptions: structure of any kind in a residual, without a name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.calibration.effects import ChannelEffect, powers
from magbridge.calibration.instrument_effects import RateEffect, ResponseEffect
from magbridge.calibration.mass_effects import LegendreEffect, PathEffect
from magbridge.calibration.memory_effects import ClockEffect, PlayEffect
from magbridge.calibration.terms import Effect
from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.causes.timing import field_rates, mass_rates
from magbridge.diagnose.compare.design_columns import Columns, effect_columns, size_of
from magbridge.diagnose.compare.interpolation import rates
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.unexplained import shapes
from magbridge.diagnose.unexplained.packets import packets, passage

__all__ = ["Description", "descriptions"]

BODY, EARTH = 24, 48
"""Half waves per log of slow curves along the axes of the body, and along the field."""


def _is(*kinds: type[Effect]) -> Callable[[Candidate], bool]:
    """Return the question whether a candidate has an effect of these kinds."""
    return lambda candidate: any(isinstance(effect, kinds) for effect in candidate.effects)


class Description(NamedTuple):
    """A description without a name."""

    columns: Columns
    """What its coefficients add to the residual."""
    widths: tuple[tuple[str, FloatArray], ...]
    """Kind, and the prior widths (1-sigma) of the coefficients up to a common factor; each is tried."""
    channel: str | None = None
    """The telemetry that it is a function of."""
    look_elsewhere: float = 1.0
    """Number of independent descriptions that it was chosen from."""
    period: float | None = None
    """Period of a tone, s."""
    holds: Callable[[Candidate], bool] = _is()
    """Return True if the columns include a candidate's own regressors, not only those of the same channel."""
    turned: bool = False
    """The columns are the same functions along each of the body's axes."""
    remembers: bool = False
    """It follows the channel's past (from which side it came), not its value."""
    scales: bool = False
    """The effect is in proportion to each reading: a change of sensitivity, not of offset. Only for heat are
    these distinguished: for other channels both describe the effect of a cause with more numbers."""
    wider: bool = False
    """It is much more general than a cause that it holds: a signal found in addition is not a remnant, and it
    is an alternative to that cause together with another."""

    def covers(self, model: Sequence[Candidate]) -> bool:
        """Return True if it contains a cause of `model`, with more coefficients; a wider one, all causes."""
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
    """Return what a candidate changes with heat that soaks through a hull; None where it is no such one."""
    soaked = (e for e in candidate.effects if isinstance(e, ChannelEffect) and e.stages > 1)
    return next((effect.on for effect in soaked), None)


def _soaks(*, scales: bool) -> Callable[[Candidate], bool]:
    return lambda candidate: _heat(candidate) == ("scale" if scales else "offset")


def _moves(own: set[str]) -> Callable[[Candidate], bool]:
    """Return the question whether a candidate adds to what the calibration's `own` masses do."""
    return lambda candidate: any(
        isinstance(effect, LegendreEffect) or (isinstance(effect, PathEffect) and effect.channel in own)
        for effect in candidate.effects
    )


def _bends(candidate: Candidate) -> bool:
    return any(isinstance(effect, ResponseEffect) and effect.power for effect in candidate.effects)


def descriptions(problem: Problem, fit: Joint, tone: Candidate | None = None) -> list[Description]:
    """List the descriptions with which structure of any kind is searched for in a survey.

    Passages and packets are searched for in the residual of a `fit` without any cause; `tone` is the
    strongest, where tones are not among the causes.
    """
    return [
        *_in_time(problem, fit),
        *_of_reading(problem),
        *_of_channels(problem),
        *_of_attitude(problem),
        *_repeating(problem, fit, tone),
    ]


def _in_time(problem: Problem, fit: Joint) -> list[Description]:
    """Slow curves in body axes and along the field, a constant, a passing source."""
    time = problem.survey.time
    whole = max(float(time[-1] - time[0]), 1.0)
    constant = problem.reference_jacobian * ~problem.survey.learned

    def waves(count: int) -> Columns:
        return lambda rows: (
            np.stack(powers(np.exp(1j * np.pi * (time[rows] - time[0]) / whole), count)).real.T
        )

    passing, times = passage(problem, fit)
    return [
        Description(_along_axes(problem, waves(BODY)), shapes.spectra(BODY, 3), turned=True),
        Description(
            lambda rows: problem.reference_jacobian[rows, None] * waves(EARTH)(rows),
            (*shapes.spectra(EARTH, 1), ("transient", np.full(EARTH, 10.0))),
        ),
        _of("drift", lambda rows: constant[rows, None], 1.0, holds=lambda one: one.about == "constant"),
        _of("transient", passing, look_elsewhere=times),
    ]


def _of_reading(problem: Problem) -> list[Description]:
    """Functions of the field's direction, its rates of change, each axis' reading; one common delay."""
    rates = field_rates(problem)

    def body(rows: slice) -> FloatArray:
        return -problem.jacobian[rows, 6:]

    listed = [
        _of("broadband", shapes.direction(body), holds=_bends, wider=True),
        _of(
            "broadband", _along_axes(problem, lambda rows: rates[:, rows].T), 1.0,
            holds=_is(RateEffect), turned=True,
        ),
        Description(
            shapes.response(problem.reading, body), shapes.bends(), holds=_bends, wider=True
        ),
        _of("broadband", shapes.crossing(problem.reading, body)),
    ]  # fmt: skip
    if problem.calibration.parameters:
        late = effect_columns(problem, ClockEffect(), mass_rates(problem))
        listed.append(_of("broadband", late, 1.0, holds=_is(ClockEffect)))
    return listed


def _of_channels(problem: Problem) -> list[Description]:
    """Return for each channel a curve of its value, functions of its past, and functions that follow it late.

    Late, as heat soaks into a hull: an offset, or a sensitivity.
    """
    own = {parameter.name for parameter in problem.calibration.parameters}
    listed = []
    for name, channel in problem.survey.channels.items():
        if name not in problem.survey.still:
            held = _moves(own) if name in own else _is()
            now, before = shapes.curve(channel.values), shapes.hysteresis(channel.values)
            listed += [
                _of("broadband", _along_axes(problem, now), channel=name, turned=True, holds=held),
                _of("broadband", _along_axes(problem, before), channel=name, turned=True, remembers=True),
            ]
            late = shapes.delayed(problem.survey.time, channel.values)
            for scales in (False, True):
                columns = _along_axes(problem, late, scales=scales)
                held = _soaks(scales=scales) if "temperature" in channel.kinds else _is()
                more = _of("broadband", columns, channel=name, turned=True, scales=scales, holds=held)
                listed.append(more)
    return listed


def _of_attitude(problem: Problem) -> list[Description]:
    """Functions of pitch, roll and turns: what hangs in the hull, slides to its lower end, swings out."""
    if problem.survey.attitude is None:
        return []
    listed = []
    time, angles = problem.survey.time, np.unwrap(np.radians(problem.survey.attitude.T))
    roll, pitch = angles[:2]
    for down in (-np.sin(pitch), np.sin(roll) * np.cos(pitch)):
        listed += [
            _of("broadband", _along_axes(problem, shapes.curve(down)), turned=True),
            _of("switching", _along_axes(problem, shapes.lower_end(down)), turned=True),
        ]
    for angle in angles:
        swung = shapes.swings(time, rates(problem.survey, angle[None])[0])
        listed.append(_of("broadband", _along_axes(problem, swung), turned=True))
    return listed


def _repeating(problem: Problem, fit: Joint, tone: Candidate | None) -> list[Description]:
    """List what the surface does, what each dive repeats, oscillations of limited duration, and a tone."""
    survey, listed = problem.survey, []
    if "depth" in survey.channels and "depth" not in survey.still:
        above = shapes.near_surface(survey.time, survey.channels["depth"].values)
        listed.append(_of("broadband", _along_axes(problem, above), turned=True))
    if np.ptp(survey.dive):
        listed.append(_of("broadband", _along_axes(problem, shapes.repeated(problem)), turned=True))
    rings = packets(problem, fit)
    if rings is not None:
        listed.append(_of("tone", rings.columns, look_elsewhere=rings.look_elsewhere, period=rings.period))
    if tone is not None:
        period = tone.point.shape["period"][0]
        listed.append(_of("tone", tone.columns, 1.0, look_elsewhere=tone.look_elsewhere, period=period))
    return listed


def _along_axes(problem: Problem, basis: Columns, *, scales: bool = False) -> Columns:
    """Each function of `basis` along each axis of the body; with `scales`, times that axis' reading."""

    def columns(rows: slice) -> FloatArray:
        part = basis(rows)
        axes = -problem.jacobian.T[6:, rows]
        if scales:
            axes = axes * problem.reading.T[:, rows] / problem.calibration.reference.field
        return (part.T[:, None] * axes).reshape(-1, len(part)).T

    return columns


def _of(kind: str, columns: Columns, width: float = 30.0, **more: Any) -> Description:
    return Description(columns, ((kind, np.full(size_of(columns), width)),), **more)
