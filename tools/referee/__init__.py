"""Emulated autopilots that use position fixes by the rules of ArduPilot and PX4, for tests of the bridge.

Each rule is a line that names its source file. Attitude, height and the delayed time horizon, which a fix
does not change, are not emulated. :mod:`.autopilot` is the common part with the position filter, and
:mod:`.loop` runs a bridge's navigation with one of them, by GNSS receivers that may be wrong.
"""

from referee.ardupilot import ArduPilot
from referee.autopilot import Autopilot, Truth
from referee.px4 import Px4

__all__ = ["ArduPilot", "Autopilot", "Px4", "Truth"]
