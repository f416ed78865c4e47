"""Causes in moving masses: a mass that the model lacks, a mass with too few terms, and hysteresis."""

from __future__ import annotations

from itertools import product

import numpy as np

from magbridge.calibration.effects import LegendreEffect, PlayEffect, PowersEffect, SourcesEffect
from magbridge.calibration.terms import Exponents, full_order
from magbridge.diagnose.causes.base import Cause
from magbridge.diagnose.columns import AXIS_NAMES, Candidate, GridPoint, of_effect, per
from magbridge.diagnose.problem import FALL, Problem

SOURCE_DISTANCES = (0.25, 0.5)
"""Distances of sources from a mass' path that are tried, in half travels; the mass would hit nearer iron."""
SOURCE_SPACING = 1.25
"""Spacing of the sources, in units of their distance from the path: closer ones add nothing to the field."""
HYSTERESIS_BRANCHES = (
    *product((0.05, 0.15, 0.3), (0.0,), (4.0,)),
    *product((0.15, 0.3), (-1.0 / 3.0, 0.0, 1.0 / 3.0), (0.5,)),
)
"""Loops of hysteresis that are tried, of drives (practically linear), then of steel: width as a fraction of
the whole travel; centre (from the middle) and scale as fractions of half the travel."""


def _powers(problem: Problem, effect: PowersEffect, channel: str | None) -> Candidate:
    """Return the candidate of an offset that is a polynomial of a mass' position."""
    step = f"{effect.scale:.3g} {problem.survey.channels[effect.channel].unit}".rstrip()
    width = np.repeat(100.0 * FALL ** np.arange(effect.order), 3)
    units = [per(step, power) for power in range(1, effect.order + 1)]
    return of_effect(problem, effect, width, units, channel=channel)


class UnmodelledActuator(Cause):
    """Another moving part carries iron: ``T += G(r(p)) m``, to third order in its position p.

    See :mod:`~magbridge.calibration.dipole` for G, the dipole field.
    """

    name = "unmodelled_actuator"
    meaning = "something that moves carries iron, and the calibration does not know of it"
    needs = "the position of something that moves"
    disambiguation = "move it at one attitude"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return a polynomial of order 1, 2 and 3 for each channel that may be a position."""
        made = []
        for name in problem.channels_of("position"):
            low, high = problem.survey.channels[name].extent
            scale, centres = 0.5 * (high - low), [0.5 * (low + high), low, high]
            if problem.survey.fitted.any():
                centres = centres[:1]
            for order, centre in product((1, 2, 3), centres):
                effect = PowersEffect(cause=self.name, channel=name, centre=centre, scale=scale, order=order)
                made.append(_powers(problem, effect, name))
        return made


class ActuatorOrder(Cause):
    """A mass' polynomial lacks terms: ``T += b prod P_e_k(x_k)`` (Legendre), or sources near its path."""

    name = "actuator_order"
    meaning = "a mass that the calibration knows acts in a finer way than it describes"
    needs = "a calibration with parameters"
    disambiguation = "move one mass in small steps over its whole range at one attitude"
    family = "mass"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return each missing term, all orders of each mass together, and sources along each mass' path.

        Missing terms up to the next order (paper, eq. 8) are Legendre polynomials, because the calibration
        has absorbed the lower orders. Sources describe a mass that passes close to iron.
        """
        calibration = problem.calibration
        if not calibration.parameters:
            return []
        # What the calibration's polynomials lack, up to one order more
        present = {e for term in calibration.terms for e in term.exponents}
        # Legendre terms that are missing, then whole masses again, then sources near each path
        order = max(sum(e) for e in present) + 1
        missing = [e for e in full_order(len(calibration.parameters), order) if e not in present]
        moved = [p for p in calibration.parameters if np.ptp(problem.survey.channels[p.name].extent) > 0.0]
        changed = [
            PowersEffect(cause=self.name, channel=p.name, centre=p.centre, scale=p.scale, order=order)
            for p in moved
        ]
        return [
            *(self._term(problem, e) for e in missing),
            *(_powers(problem, effect, None) for effect in changed),
            *(_sources(problem, self.name, p.name, near) for p in moved for near in SOURCE_DISTANCES),
        ]

    def _term(self, problem: Problem, exponents: Exponents) -> Candidate:
        own = [(p, e) for p, e in zip(problem.calibration.parameters, exponents, strict=True) if e]
        label = " ".join(f"P{e}({p.name})" for p, e in own)
        effect = LegendreEffect(cause=self.name, exponents=exponents)
        return of_effect(problem, effect, 50.0, "nT", names=tuple(f"{axis} {label}" for axis in AXIS_NAMES))


def _sources(problem: Problem, cause: str, name: str, distance: float) -> Candidate:
    """Return one candidate of sources along a mass' path and a little beyond, all of one common size."""
    low, high = problem.survey.channels[name].extent
    scale = 0.5 * distance * (high - low)
    # Sources at equal distances, from one end of the path to a little beyond the other
    gaps = int(np.ceil(2.0 / (SOURCE_SPACING * distance)))
    centre = 0.5 * (low + high - gaps * SOURCE_SPACING * scale)
    effect = SourcesEffect(
        cause=cause, channel=name, centre=centre, scale=scale, apart=SOURCE_SPACING, count=gaps + 1
    )
    places = centre + SOURCE_SPACING * scale * np.arange(gaps + 1)
    names = tuple(f"{axis} {name} {x:.3g}" for x in places for axis in AXIS_NAMES)
    return of_effect(problem, effect, 50.0, "nT", names=names, spectra=np.ones((1, effect.size)))


class Hysteresis(Cause):
    """Backlash of a drive, or remagnetised steel: ``T += b (S(y) - S(p)) / width``, y the play operator of p.

    S is linear for the backlash of a drive. For steel S is steep only near the steel: see
    :class:`~magbridge.calibration.effects.PlayEffect`.
    """

    name = "hysteresis"
    meaning = (
        "a mass acts differently depending on where it came from: play in its drive, or steel that stays "
        "magnetised"
    )
    needs = "a calibration with parameters"
    disambiguation = "approach one position from both sides"

    def candidates(self, problem: Problem) -> list[Candidate]:
        """Return each of :data:`HYSTERESIS_BRANCHES` for each mass of the model that moves."""
        made = []
        for parameter in problem.calibration.parameters:
            low, high = problem.survey.channels[parameter.name].extent
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            if half > 0.0:
                made += [
                    self._play(
                        problem, parameter.name, 2.0 * half * width, middle + half * centre, half * scale
                    )
                    for width, centre, scale in HYSTERESIS_BRANCHES
                ]
        return made

    def _play(self, problem: Problem, name: str, width: float, centre: float, scale: float) -> Candidate:
        unit = problem.survey.channels[name].unit
        effect = PlayEffect(cause=self.name, channel=name, width=width, centre=centre, scale=scale)
        shape = {"width": (width, unit), "centre": (centre, unit), "scale": (scale, unit)}
        point = GridPoint(shape, lambda *other: self._play(problem, name, *other))
        return of_effect(problem, effect, 50.0, "nT", channel=name, point=point)
