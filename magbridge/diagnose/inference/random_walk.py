r"""Whether what a slow cause explains may be noise: a random walk of the sensor's offsets in its place.

Notes
-----
A random walk has a power of 1/f^2: half waves of variance ``g / k^2`` in place of the ``g / k`` of
:mod:`~magbridge.diagnose.compare.slow_noise`. Most of that is of the lowest frequencies, of which a step or a
drift of a low signal-to-noise is, too, so a log may not tell them apart. Both are weighed by their evidence,
each autoregression at Akaike's price: beside a walk it is shorter.
"""

from __future__ import annotations

import numpy as np

from magbridge.diagnose.compare.problem import with_slow_noise
from magbridge.diagnose.inference.fit_noise import autoregressive_order
from magbridge.diagnose.inference.hypothesis import Hypothesis
from magbridge.diagnose.inference.joint import fit_joint
from magbridge.diagnose.inference.search import Outcome

__all__ = ["odds_over_random_walk"]


def odds_over_random_walk(outcome: Outcome, own: Hypothesis) -> float:
    """Return the log odds of one cause that was chosen over a random walk in its place."""
    slots, noise = outcome.problem.survey.slots, outcome.null.noise
    others = [one.candidate for one in outcome.chosen if one is not own]
    columns, spectra = [one.columns for one in others], [one.spectra for one in others]
    walking = with_slow_noise(outcome.problem, 2)
    rough = fit_joint(walking, columns, 1, spectra=spectra, rounds=2)
    order = autoregressive_order(rough.residual, slots)
    walk = fit_joint(walking, columns, order, spectra=spectra, blocks=noise.uneven)
    without = fit_joint(outcome.problem, columns, noise.past.order, spectra=spectra, blocks=noise.uneven)
    # coefficients that what is left no longer needs have each gained half a nat by chance
    price = 0.5 * (noise.past.order + autoregressive_order(outcome.fit.residual, slots))
    price += float(np.log(outcome.look_elsewhere[own.candidate.cause]))
    return own.evidence - price + without.log_likelihood - (walk.log_likelihood - order)
