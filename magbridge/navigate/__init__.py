"""Position from the corrected field and an anomaly map, where there is no GPS."""

from magbridge.navigate.bound import Bound, position_bound
from magbridge.navigate.model import Options
from magbridge.navigate.navigator import Navigator
from magbridge.navigate.record import Record, State

__all__ = ["Bound", "Navigator", "Options", "Record", "State", "position_bound"]
