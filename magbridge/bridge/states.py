"""Changes of ports, log and host clock as frames of the dialect, for logs and replays."""

from __future__ import annotations

from magbridge.bridge.port import Port
from magbridge.mavlink.codec import Codec
from magbridge.mavlink.enums import MAG_PORT_NAME, MAG_PORT_STATE, MAV_SEVERITY

__all__ = ["clock_step", "interleaved", "log_state", "notice", "opened", "port", "standstill", "too_slow"]


def _frame(name: str, **fields: object) -> bytes:
    return Codec(0, 0).pack(name, **fields)


def clock_step(time_us: int, step_us: int) -> bytes:
    """Return the frame for a step of the host's clock by `step_us` µs."""
    return _frame("MAG_CLOCK_STEP", time_usec=time_us + step_us, step=step_us)


def standstill(time_us: int, duration_us: int) -> bytes:
    """Return the frame for a stall of the bridge of `duration_us` µs that ends now."""
    return _frame("MAG_HOST_STALL", time_usec=time_us, duration=min(duration_us, 2**32 - 1))


def interleaved(count: int) -> bytes:
    """Return the frame for `count` sent frames that are not in the log."""
    return _frame("MAG_INTERLEAVED", count=count)


def notice(text: str, severity: MAV_SEVERITY = MAV_SEVERITY.WARNING) -> bytes:
    """Return the frame of a text that the bridge forwards, at most 50 characters."""
    return _frame("STATUSTEXT", severity=int(severity), text=text)


def port(number: int, link: Port, reason: str) -> bytes:
    """Return the frame for a port that opened (no `reason`) or that is not open, with the reason."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    # the name last, because the end of a long text is cut off
    why = f"{reason}: {link.name}" if reason else ""
    return _frame("MAG_PORT", port=number, state=int(state), dropped=link.dropped, reason=why)


def too_slow(number: int, link: Port) -> bytes:
    """Return the frame for an open port that is too slow for the sent data."""
    why = f"too slow, {link.overrun} bytes not sent so far"
    state = int(MAG_PORT_STATE.OK)
    return _frame("MAG_PORT", port=number, state=state, dropped=link.dropped, reason=why)


def opened(name: int) -> bytes:
    """Return the frame for a port that opened, for a replay, which has no `Port`."""
    return _frame("MAG_PORT", port=int(name), state=int(MAG_PORT_STATE.OK))


def log_state(reason: str, lost: int) -> bytes:
    """Return the frame for the log's state: written (no `reason`) or not, and the lost records."""
    state = MAG_PORT_STATE.LOST if reason else MAG_PORT_STATE.OK
    return _frame("MAG_PORT", port=int(MAG_PORT_NAME.LOG), state=int(state), dropped=lost, reason=reason)
