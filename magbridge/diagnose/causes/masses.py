"""What moves carries iron: masses that the model lacks, has too few terms for, or that remember where they were."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.followers import MonomialEffect, PlayEffect, PowersEffect
from magbridge.calibration.terms import full_order
from magbridge.diagnose.candidates import AXES, Candidate, of_effect
from magbridge.diagnose.causes.channels import channels_of, extent
from magbridge.diagnose.problem import Problem

__all__ = ["actuator_order", "hysteresis", "unmodelled_actuator"]

FloatArray = NDArray[np.float64]


def unmodelled_actuator(problem: Problem) -> list[Candidate]:
    """Something else that moves carries iron: ``T += G(r(p)) m``, to third order in p (see :mod:`~.calibration.dipole`)."""
    made = []
    for name in channels_of(problem, "position"):
        low, high = extent(problem, name)
        scale = 0.5 * (high - low)
        centres = [0.5 * (low + high)] if problem.survey.learned.any() else [0.5 * (low + high), low, high]
        for order, centre in product((1, 2, 3), centres):
            effect = PowersEffect(
                cause="unmodelled_actuator", channel=name, centre=centre, scale=scale, order=order
            )
            width = np.repeat(100.0 * 0.3 ** np.arange(order), 3)
            made.append(
                of_effect(
                    problem,
                    effect,
                    width,
                    f"nT per {scale:.3g} {problem.survey.channels[name].unit}",
                    channel=name,
                )
            )
    return made


def actuator_order(problem: Problem) -> list[Candidate]:
    """A modelled mass needs a power or a cross term that its polynomial lacks: ``T += b prod x_k^e_k`` (paper, eq. 8)."""
    calibration = problem.calibration
    k = len(calibration.parameters)
    if not k:
        return []
    present = {e for term in calibration.terms for e in term.expand(calibration).exponents}
    highest = max(sum(e) for e in present)
    made = []
    for exponents in full_order(k, min(highest + 1, 5)):
        if exponents not in present:
            effect = MonomialEffect(cause="actuator_order", exponents=exponents)
            label = " ".join(
                f"{p.name}^{e}" if e > 1 else p.name
                for p, e in zip(calibration.parameters, exponents, strict=True)
                if e
            )
            names = tuple(f"{axis} {label}" for axis in AXES)
            made.append(of_effect(problem, effect, 50.0, "nT", names=names))
    return made


def hysteresis(problem: Problem) -> list[Candidate]:
    """Backlash of the drive, or steel remagnetised by its own motion: ``T += b (y - p) / width``, y the play of p."""
    made = []
    # only of masses that are modelled: a wide play of another is that other itself
    for name in (parameter.name for parameter in problem.calibration.parameters):
        low, high = extent(problem, name)

        def again(width: float, name: str = name) -> Candidate:
            effect = PlayEffect(cause="hysteresis", channel=name, width=width)
            unit = problem.survey.channels[name].unit
            return of_effect(
                problem, effect, 50.0, "nT", channel=name, shape={"width": (width, unit)}, again=again
            )

        made += [again(share * (high - low)) for share in (0.05, 0.15, 0.3, 0.5)]
    return made
