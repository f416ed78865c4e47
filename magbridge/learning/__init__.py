"""The bridge learns: the calibration's coefficients as a state, and doubt in what they no longer explain.

:class:`Learner` takes the samples that the bridge corrects. An :mod:`.estimator` learns coefficients from
them, a :mod:`.judge` compares what the calibrations predict, and :mod:`.doubt` says when none explains the
data.
"""

from magbridge.learning.learner import Learner
from magbridge.learning.report import Notice

__all__ = ["Learner", "Notice"]
