"""Check whether corrected samples can be the Earth's field, and whether the calibration still holds.

:class:`HealthMonitor` runs :mod:`.checks` (repeated readings, the main field), :mod:`.scatter` (noise),
:mod:`.trend` (outliers and jumps) and :mod:`.consistency` (dependence on attitude, temperature and masses);
:class:`DirectionCheck` needs the autopilot's attitude. A check is cheap, uses the times of the samples
as its only clock, and returns flags and a variance. The package does not depend on logs or MAVLink. Start
with :mod:`.monitor`.
"""

from magbridge.health.checks import Messages
from magbridge.health.direction import DirectionCheck
from magbridge.health.monitor import HealthMonitor

__all__ = ["DirectionCheck", "HealthMonitor", "Messages"]
