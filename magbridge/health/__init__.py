"""Check corrected samples: can they be the Earth's field, and does the calibration still hold.

:class:`HealthMonitor` runs :mod:`.checks` (repeated readings, the main field), :mod:`.scatter` (noise),
:mod:`.trend` (outliers and jumps) and :mod:`.consistency` (dependence on attitude, temperature and masses);
:class:`DirectionCheck` needs the autopilot's attitude. A check is cheap, uses only the times of events, and
returns flags and a variance. The package uses ``estimation`` and knows neither logs nor MAVLink. Start with
:mod:`.monitor`.
"""

from magbridge.health.checks import Messages
from magbridge.health.direction import DirectionCheck
from magbridge.health.monitor import HealthMonitor

__all__ = ["DirectionCheck", "HealthMonitor", "Messages"]
