"""Estimate the calibration's coefficients on board, and detect changes that the model does not explain.

:class:`Learner` receives the samples that the bridge corrects. An :mod:`.estimator` learns the coefficients
from the samples, a :mod:`.judge` compares the predictions of initial and learned calibrations, and
:mod:`.alarms` raises an alarm if no calibration explains the data.
"""

from magbridge.learning.learner import Learner, Notice

__all__ = ["Learner", "Notice"]
