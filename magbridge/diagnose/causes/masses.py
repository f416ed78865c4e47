"""Masses carry iron: those that the model lacks, has too few terms for, or that remember where they were."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from magbridge.calibration.mass_effects import LegendreEffect, PowersEffect, SourcesEffect
from magbridge.calibration.memory_effects import PlayEffect
from magbridge.calibration.terms import Polynomial, full_order
from magbridge.diagnose.columns import AXES, Candidate, GridPoint, of_effect, per
from magbridge.diagnose.problem import FALL, Problem

__all__ = ["actuator_order", "hysteresis", "unmodelled_actuator"]

SOURCE_DISTANCES = (0.25, 0.5)
"""Distances of sources from a mass' path that are tried, in half travels; nearer iron would be struck."""
SOURCE_SPACING = 1.25
"""Spacing of the sources, in units of their distance from the path: closer ones make the same field."""
STRAIGHT_BRANCH_SCALE = 4.0
"""Scale, in half travels, of a branch of hysteresis that is practically straight."""


def unmodelled_actuator(problem: Problem) -> list[Candidate]:
    """Something else that moves carries iron: ``T += G(r(p)) m``, to third order in p.

    See :mod:`~magbridge.calibration.dipole`.
    """
    made = []
    for name in problem.channels_of("position"):
        low, high = problem.survey.channels[name].extent
        scale = 0.5 * (high - low)
        centres = [0.5 * (low + high)] if problem.survey.fitted.any() else [0.5 * (low + high), low, high]
        for order, centre in product((1, 2, 3), centres):
            effect = PowersEffect(
                cause="unmodelled_actuator", channel=name, centre=centre, scale=scale, order=order
            )
            made.append(_series(problem, effect, channel=name))
    return made


def _series(problem: Problem, effect: PowersEffect, channel: str | None = None) -> Candidate:
    """Return the powers of a mass' position."""
    order = effect.order
    step = f"{effect.scale:.3g} {problem.survey.channels[effect.channel].unit}".rstrip()
    return of_effect(
        problem,
        effect,
        np.repeat(100.0 * FALL ** np.arange(order), 3),
        [per(step, power) for power in range(1, order + 1)],
        channel=channel,
    )


def actuator_order(problem: Problem) -> list[Candidate]:
    """A mass needs what its polynomial lacks: ``T += b prod P_e_k(x_k)``, P Legendre's, or sources near it.

    Candidates are each missing term up to the next order (paper, eq. 8), as a Legendre polynomial, since the
    calibration has absorbed the lower orders; all orders of one mass together, if its field has changed
    since; and a row of sources (:class:`~magbridge.calibration.mass_effects.SourcesEffect`): of a mass that
    passes close to iron no polynomial of a low order follows the field. The sources have one common size.
    """
    calibration = problem.calibration
    if not calibration.parameters:
        return []
    present = {e for term in calibration.terms if isinstance(term, Polynomial) for e in term.exponents}
    order = max(sum(e) for e in present) + 1
    missing = [e for e in full_order(len(calibration.parameters), order) if e not in present]
    moved = [p for p in calibration.parameters if np.ptp(problem.survey.channels[p.name].extent) > 0.0]
    changed = [
        PowersEffect(cause="actuator_order", channel=p.name, centre=p.centre, scale=p.scale, order=order)
        for p in moved
    ]
    return [
        *(_term(problem, e) for e in missing),
        *(_series(problem, effect) for effect in changed),
        *(_sources(problem, p.name, near) for p in moved for near in SOURCE_DISTANCES),
    ]


def _sources(problem: Problem, name: str, near: float) -> Candidate:
    """Return sources all along one mass' path, and a little beyond its ends."""
    low, high = problem.survey.channels[name].extent
    scale = 0.5 * near * (high - low)
    gaps = int(np.ceil(2.0 / (SOURCE_SPACING * near)))
    centre = 0.5 * (low + high - gaps * SOURCE_SPACING * scale)
    effect = SourcesEffect(
        cause="actuator_order", channel=name, centre=centre, scale=scale, apart=SOURCE_SPACING, count=gaps + 1
    )
    at = centre + SOURCE_SPACING * scale * np.arange(gaps + 1)
    names = tuple(f"{axis} {name} {x:.3g}" for x in at for axis in AXES)
    return of_effect(problem, effect, 50.0, "nT", names=names, spectra=np.ones((1, effect.size)))


def _term(problem: Problem, exponents: tuple[int, ...]) -> Candidate:
    own = [(p, e) for p, e in zip(problem.calibration.parameters, exponents, strict=True) if e]
    label = " ".join(f"P{e}({p.name})" for p, e in own)
    effect = LegendreEffect(cause="actuator_order", exponents=exponents)
    return of_effect(problem, effect, 50.0, "nT", names=tuple(f"{axis} {label}" for axis in AXES))


def hysteresis(problem: Problem) -> list[Candidate]:
    """Backlash of a drive, or moving steel remagnetised: ``T += b (S(y) - S(p)) / width``, y the play of p.

    S is straight for the backlash of a drive; for steel it is steep where the steel is: see
    :class:`~magbridge.calibration.memory_effects.PlayEffect`.
    """
    drives = product((0.05, 0.15, 0.3), (0.0,), (STRAIGHT_BRANCH_SCALE,))
    steel = product((0.15, 0.3), (-1.0 / 3.0, 0.0, 1.0 / 3.0), (0.5,))
    # only of modelled masses: the difference between any other channel and its wide play is that channel
    names = [parameter.name for parameter in problem.calibration.parameters]
    shapes = [*drives, *steel]
    return [
        made
        for name in names
        if np.ptp(problem.survey.channels[name].extent) > 0.0
        for made in _plays(problem, name, shapes)
    ]


def _plays(problem: Problem, name: str, shapes: Sequence[tuple[float, float, float]]) -> list[Candidate]:
    """Return one mass' candidates.

    In `shapes`, widths are in units of its whole travel, centres (from the middle) and scales of half of it.
    """
    low, high = problem.survey.channels[name].extent
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    unit = problem.survey.channels[name].unit

    def rebuild(width: float, centre: float, scale: float) -> Candidate:
        effect = PlayEffect(cause="hysteresis", channel=name, width=width, centre=centre, scale=scale)
        shape = {"width": (width, unit), "centre": (centre, unit), "scale": (scale, unit)}
        return of_effect(problem, effect, 50.0, "nT", channel=name, point=GridPoint(shape, rebuild))

    return [rebuild(2.0 * half * w, middle + half * c, half * s) for w, c, s in shapes]
