"""Position from the corrected field and an anomaly map, without GPS.

::

    telemetry --> deadreckoning --+
                                  +--> collect --> estimate --> record
    corrected samples ------------+    (blocks)    (tracker or bank, integrity)

A :class:`Navigator` receives telemetry and samples in order of time. :mod:`.deadreckoning` computes the
dead-reckoned position, and :mod:`.model` averages samples to blocks within which the map is linear.
:mod:`.estimate` estimates the error of dead reckoning by a :mod:`.bank` of one Kalman filter, or of many if
the position is uncertain; :mod:`.integrity` tests the estimate. Each update yields a :mod:`.record`.
:mod:`.options` hold the prior uncertainties, and continue the map to the vehicle's depth.

Ashore, :mod:`.batch` runs the same navigator over a log and smooths the track; :mod:`.findings` and
:mod:`.draw` report its errors. :mod:`.bound` predicts the smallest position error before the dive.
Without a map :mod:`.own_survey` localises a log by the field that repeats along it, by :mod:`.particles`.
"""

from magbridge.navigate.bound import Bound, position_bound
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.record import NavigationState, Record

__all__ = ["Bound", "NavigationOptions", "NavigationState", "Navigator", "Record", "position_bound"]
