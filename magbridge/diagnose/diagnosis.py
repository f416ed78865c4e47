"""What a diagnosis ends with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magbridge.calibration.model import Calibration
from magbridge.diagnose.compare.problem import Problem
from magbridge.diagnose.gain import Gain
from magbridge.diagnose.inference.isolability import Isolability
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.outliers import Outliers
from magbridge.diagnose.inference.rivals import Rival
from magbridge.diagnose.inference.search import Hypothesis, Outcome
from magbridge.diagnose.inference.unexplained import Leftover

__all__ = ["Diagnosis"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that was found out.

    Attributes
    ----------
    problem : Problem
    outcome : Outcome
    named : tuple of Hypothesis
        The causes that stand; their rivals in `rivals`.
    rivals : tuple of tuple of Rival
    wrong : Outliers or None
        Isolated wrong samples.
    unexplained : Leftover or None
    calibration : Calibration
        Extended.
    fit : Joint
        At the extended calibration.
    before, after : (n,) array
        nT, residuals with the calibration as it was, and extended, held out.
    total : Gain
    gains : tuple of Gain
        Of each named cause beside the others.
    isolability : Isolability
    verdict : str
    """

    problem: Problem
    outcome: Outcome
    named: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    wrong: Outliers | None
    unexplained: Leftover | None
    calibration: Calibration
    fit: Joint
    before: FloatArray
    after: FloatArray
    total: Gain
    gains: tuple[Gain, ...]
    isolability: Isolability
    verdict: str
