"""Changes of ports, log and host's clock as frames of our own dialect, which are logged and replayed."""

from __future__ import annotations

from magbridge.bridge.port import Port
from magbridge.mavlink.codec import Codec
from magbridge.mavlink.enums import MAG_PORT_NAME, MAG_PORT_STATE, MAV_SEVERITY

__all__ = ["clock_step", "interleaved", "log_state", "notice", "opened", "port", "standstill", "too_slow"]


def _frame(name: str, **fields: object) -> bytes:
    return Codec(0, 0).pack(name, **fields)


def clock_step(time_us: int, step_us: int) -> bytes:
    """Return the frame that says that the host's clock was set by `step_us` µs."""
    return _frame("MAG_CLOCK_STEP", time_usec=time_us + step_us, step=step_us)


def standstill(time_us: int, duration_us: int) -> bytes:
    """Return the frame that says that until now the bridge stood still for `duration_us` µs."""
    return _frame("MAG_HOST_STALL", time_usec=time_us, duration=min(duration_us, 2**32 - 1))


def interleaved(count: int) -> bytes:
    """Return the frame that says that `count` frames were sent which are not in the log."""
    return _frame("MAG_INTERLEAVED", count=count)


def notice(text: str, severity: MAV_SEVERITY = MAV_SEVERITY.WARNING) -> bytes:
    """Return the frame of a text that the bridge is to pass on, at most 50 characters."""
    return _frame("STATUSTEXT", severity=int(severity), text=text)


def port(number: int, what: Port, reason: str) -> bytes:
    """Return the frame that says that a port opened (no `reason`) or which one is not open, and why."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    # the name last, because the end of a long text is cut off
    why = f"{reason}: {what.name}" if reason else ""
    return _frame("MAG_PORT", port=number, state=int(state), dropped=what.dropped, reason=why)


def too_slow(number: int, what: Port) -> bytes:
    """Return the frame that says that an open port does not take all that is sent."""
    why = f"too slow, {what.overrun} bytes not sent so far"
    state = int(MAG_PORT_STATE.OK)
    return _frame("MAG_PORT", port=number, state=state, dropped=what.dropped, reason=why)


def opened(name: int) -> bytes:
    """Return the frame that says that a port opened, for a replay, which has no `Port`."""
    return _frame("MAG_PORT", port=int(name), state=int(MAG_PORT_STATE.OK))


def log_state(reason: str, lost: int) -> bytes:
    """Return the frame that says that the log is being written (no `reason`) or why not, and records lost."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    return _frame("MAG_PORT", port=int(MAG_PORT_NAME.LOG), state=int(state), dropped=lost, reason=reason)
