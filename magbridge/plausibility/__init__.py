"""Whether a corrected sample can be the Earth's field, judged by those before it and by the main field.

Every check is cheap, knows only the time of events, and needs nothing but the samples:
:mod:`~magbridge.plausibility.level` beside the main field, :mod:`~magbridge.plausibility.axes` that are
stuck, a :mod:`~magbridge.plausibility.jump` off the trend and what it leaves
(:mod:`~magbridge.plausibility.moves`), and :mod:`~magbridge.plausibility.scatter` beyond the calibration's.
"""

from magbridge.plausibility.attitude import Attitude
from magbridge.plausibility.judge import Plausibility

__all__ = ["Attitude", "Plausibility"]
