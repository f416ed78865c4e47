"""Autopilots that do with position fixes what ArduPilot and PX4 do, for a bridge to be tried against.

Each rule of theirs is a line that names the source file it stands in. What is left out is what a fix does not
touch: attitude, height, and the delayed time horizon. :mod:`.filter` is the position filter,
:mod:`.autopilot` what both share, and :mod:`.loop` sails a bridge's navigation with one of them.
"""

from referee.ardupilot import ArduPilot
from referee.autopilot import Autopilot, Truth
from referee.px4 import Px4

__all__ = ["ArduPilot", "Autopilot", "Px4", "Truth"]
