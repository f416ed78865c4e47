"""Emulated autopilots that use position fixes by the rules of ArduPilot and PX4, for tests of the bridge.

A comment at each rule names its source file. The emulation omits attitude, height and the delayed time
horizon, which a fix does not change. :mod:`.autopilot` is the common part with the position filter;
:mod:`.loop` runs a bridge's navigation with an emulated autopilot and with GNSS receivers that may be wrong.
"""

from referee.ardupilot import ArduPilot
from referee.autopilot import Autopilot, Truth
from referee.px4 import Px4

__all__ = ["ArduPilot", "Autopilot", "Px4", "Truth"]
