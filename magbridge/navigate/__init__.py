"""Position from the corrected field and an anomaly map, without GPS.

::

    telemetry --> deadreckoning --+
                                  +--> collect --> estimate --> record
    corrected samples ------------+    (blocks)    (tracker or bank, integrity)

A :class:`Navigator` takes both in, in order of time. :mod:`.deadreckoning` moves a position along, and
:mod:`.model` averages the samples between which the map is linear. :mod:`.estimate` finds how far off dead
reckoning is, on the states of :mod:`.model`, by a :mod:`.bank` of one Kalman filter where the position is
narrow enough, else of many; :mod:`.integrity` tests whether it is right. Each update is a :mod:`.record`.
:mod:`.options` hold the prior uncertainties, and bring the map to the vehicle's depth.

Ashore, :mod:`.batch` runs the same navigator over a log and smooths the track; :mod:`.findings` and
:mod:`.draw` report how good it is. :mod:`.bound` computes what a map is worth before the dive.
Without a map :mod:`.own_survey` localises a whole log in the field that it met itself, by :mod:`.particles`.
"""

from magbridge.navigate.bound import Bound, position_bound
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.options import NavigationOptions
from magbridge.navigate.record import NavigationState, Record

__all__ = ["Bound", "NavigationOptions", "NavigationState", "Navigator", "Record", "position_bound"]
