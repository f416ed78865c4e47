"""Whether a corrected sample can be the Earth's field, judged by those before it and by the main field.

Every check is cheap, knows only the time of events, and needs nothing but the samples:
:mod:`~magbridge.health.level` beside the main field, :mod:`~magbridge.health.axes` that are
stuck, a :mod:`~magbridge.health.jump` off the trend and what it leaves
(:mod:`~magbridge.health.moves`), and :mod:`~magbridge.health.scatter` beyond the calibration's.
"""

from magbridge.health.attitude import Attitude
from magbridge.health.judge import Plausibility

__all__ = ["Attitude", "Plausibility"]
