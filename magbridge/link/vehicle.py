"""Monitoring of the vehicle: clock offset, presence and reboots of the autopilot, lost frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import nan, sqrt
from typing import Final, NamedTuple

from magbridge.link.output import Output
from magbridge.mavlink import Message, spec
from magbridge.mavlink.enums import MAG_PORT_STATE, MAV_AUTOPILOT, MAV_SEVERITY, MAV_TYPE

__all__ = ["VehicleClock", "VehicleState"]

CLOCK_EXCHANGES = 32
"""Number of the latest TIMESYNC exchanges in the fit, and of earlier blocks of as many exchanges, of each of
which the fit keeps the fastest: 17 minutes at one exchange a second."""
JITTER_US = 200.0
"""Standard deviation of the offset from the fastest exchange, µs."""
WANDER, DRIFT_SIGMA = 1e-6, 1e-4
"""Error of the line at an earlier exchange for each µs of age, and prior 1-sigma of the drift, µs/µs."""
EXCESS_SIGMA = 0.5 * CLOCK_EXCHANGES**0.5
"""Standard deviation of an offset for each µs by which its round trip exceeds the fastest. Half of the excess
is the error of one exchange; a queue in one direction is common to a whole block."""
STEP_US, DRIFT, SET_SIGMA = 20_000, 500e-6, 3.0
"""Thresholds (µs, µs/µs, 1) for a clock that was set: an offset differs from the line by more than half of
both round trips, plus STEP_US, DRIFT times the time since the last exchange, and SET_SIGMA times sigma."""
SPAN_US = 10_000_000
"""Shortest time from the first to the last exchange for an estimate of the drift, µs."""
PENDING = 8


class Exchange(NamedTuple):
    """TIMESYNC exchange: middle of the round trip on the bridge's clock, offset, and round trip, µs."""

    middle_us: int
    offset_us: int
    trip_us: int


class VehicleClock:
    """Estimate of the offset ``vehicle clock - bridge clock`` and its drift, from TIMESYNC exchanges.

    `sigma`: standard deviation of the offset, s; NaN while unknown.

    Notes
    -----
    An exchange sent at ``ts``, answered with the vehicle's ``tc`` and received at ``tr`` gives
    ``offset = tc - (ts + tr) / 2``, with an error of at most half the round trip ``tr - ts``. An exchange
    slower than the fastest one was delayed in an unknown direction (Cristian, 1989, uses only the fastest
    exchange). So a straight line is fitted with the weights ``1 / sigma^2``, where
    ``sigma = JITTER + EXCESS_SIGMA * (trip - min trip) + WANDER * age``. A link may be slow for minutes, as
    when a radio is full. So the fastest exchange of each earlier block stays in the fit. The stated sigma
    also counts the scatter about the line, and an error of the fastest exchange uniform in half its round
    trip.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard all exchanges and the estimate, because the vehicle's clock restarted or was set."""
        self._asked: deque[int] = deque(maxlen=PENDING)
        self._exchanges: deque[Exchange] = deque(maxlen=CLOCK_EXCHANGES)
        self._fastest: deque[Exchange] = deque(maxlen=CLOCK_EXCHANGES)
        self._count = 0
        self._base_us = self._middle_us = 0
        self._offset, self._slope = 0.0, 0.0
        self._span_us = 0
        self.sigma = nan

    @property
    def known(self) -> bool:
        """True if the offset has been estimated."""
        return bool(self._exchanges)

    @property
    def drift_ppm(self) -> float:
        """Rate error of the vehicle's clock against the bridge's, ppm, positive if fast; NaN if unknown."""
        return self._slope * 1e6 if self._span_us >= SPAN_US else nan

    def ask(self, now_us: int) -> int:
        """Record a TIMESYNC request sent at `now_us` (µs); return its field ``ts1`` (ns)."""
        self._asked.append(now_us * 1000)
        return now_us * 1000

    def answer(self, tc1: int, ts1: int, now_us: int) -> None:
        """Update the estimate with a TIMESYNC reply (`tc1`, `ts1` in ns) received at `now_us` (µs).

        Ignore a reply whose `ts1` is not that of a pending request.
        """
        if ts1 not in self._asked:
            return
        self._asked.remove(ts1)
        sent_us = ts1 // 1000
        trip_us = now_us - sent_us
        middle_us = sent_us + trip_us // 2
        new = Exchange(middle_us, tc1 // 1000 - middle_us, trip_us)
        if self.known:
            fastest_us = min(one.trip_us for one in self._exchanges)
            allowed_us = STEP_US + (trip_us + fastest_us) / 2 + DRIFT * (middle_us - self._middle_us)
            allowed_us += SET_SIGMA * self.sigma * 1e6
            if abs(new.offset_us - self.offset_us(middle_us)) > allowed_us:
                self.reset()
        if len(self._exchanges) == CLOCK_EXCHANGES:
            old = self._exchanges[0]  # of each block, the fastest exchange is kept
            if self._count % CLOCK_EXCHANGES == 0:
                self._fastest.append(old)
            elif old.trip_us < self._fastest[-1].trip_us:
                self._fastest[-1] = old
            self._count += 1
        self._exchanges.append(new)
        self._fit()

    def _fit(self) -> None:
        exchanges = (*self._fastest, *self._exchanges)
        fastest = min(one.trip_us for one in exchanges)
        self._middle_us, self._base_us, _ = exchanges[-1]
        self._span_us = self._middle_us - exchanges[0].middle_us
        # weighted sums of the normal equations, with the prior of the drift; x, y from the last exchange
        s = sx = sy = sxy = syy = 0.0
        sxx = DRIFT_SIGMA**-2
        for middle, offset, trip in exchanges:
            x, y = float(middle - self._middle_us), float(offset - self._base_us)
            weight = (JITTER_US + EXCESS_SIGMA * (trip - fastest) + WANDER * abs(x)) ** -2
            s += weight
            sx += weight * x
            sy += weight * y
            sxx += weight * x * x
            sxy += weight * x * y
            syy += weight * y * y
        determinant = s * sxx - sx * sx
        self._slope = (s * sxy - sx * sy) / determinant
        self._offset = (sxx * sy - sx * sxy) / determinant
        # chi^2 of the residuals, at least its expectation
        square = max((syy - self._offset * sy - self._slope * sxy) / max(len(exchanges) - 2, 1), 1.0)
        self.sigma = sqrt(square * sxx / determinant + fastest * fastest / 12.0) * 1e-6

    def offset_us(self, t_us: int) -> float:
        """Return vehicle clock minus bridge clock (µs) at `t_us` of the bridge clock; 0 while unknown."""
        return self._base_us + (self._offset + self._slope * (t_us - self._middle_us))

    def bridge_time(self, vehicle_us: int, t_us: int, wrap_us: int = 0) -> int:
        """Return the time of the bridge clock (µs) when the vehicle clock was `vehicle_us`; at most `t_us`.

        `vehicle_us`: time stamp of a message, vehicle clock, µs.
        `t_us`: time of reception, bridge clock, µs.
        `wrap_us`: time after which the message's time field wraps to 0, µs; 0 if it never wraps.
        """
        offset_us = round(self.offset_us(t_us))
        if wrap_us:
            vehicle_us += round((t_us + offset_us - vehicle_us) / wrap_us) * wrap_us
        return min(vehicle_us - offset_us, t_us)


LATE_FRAMES: Final = 64
"""Number of the latest sequence numbers in which a late frame is still removed from the lost frames."""
ALL_FRAMES: Final = (1 << LATE_FRAMES) - 1
LOSS_INTERVAL_US = 10_000_000
"""Interval over which the fraction of lost frames is computed, µs."""
MANY, LEAST = 0.01, 3
"""Limits for a report of lost frames in an interval: a fraction above MANY, and at least LEAST frames."""
WATCHED: Final = 16
"""Most components whose lost frames are counted."""


class Numbers:
    """Counts of received and lost frames of one component, from its sequence numbers.

    `received`, `lost`: number of frames received, and of frames missing so far.
    """

    __slots__ = ("_last", "_missing", "lost", "received")

    def __init__(self, first: int) -> None:
        self.received = self.lost = 0
        self._last = first
        self._missing = 0  # bit k: the frame k before the latest has not come

    def count(self, number: int) -> None:
        """Count the frame with sequence number `number`; a late frame no longer counts as lost."""
        self.received += 1
        ahead = (number - self._last + 128) % 256 - 128
        if -LATE_FRAMES < ahead <= 0:
            late = self._missing & 1 << -ahead
            self.lost -= late != 0
            self._missing ^= late
            return
        # a number far behind the last means that the sender restarted
        self.lost += max(ahead - 1, 0)
        self._missing = (self._missing << ahead | (1 << ahead) - 2) & ALL_FRAMES if ahead > 0 else 0
        self._last = number


HEARTBEAT: Final = spec("HEARTBEAT").id
ABSENT_US = 5_000_000
"""Time without a heartbeat after which the autopilot counts as lost, µs."""
BACK_MS: Final = 1_000
"""Largest step back of ``time_boot_ms`` that packets out of order explain, ms."""
BELIEVED = 3
"""Messages in a row with a boot time far behind that mean a reboot; a single message may be late."""
LEAP_MS: Final = 10_000
"""Largest lead of ``time_boot_ms`` over the bridge's clock, and largest lag behind other messages, that one
autopilot explains, ms."""
TWICE, CHANGES_US = 5, 10_000_000
"""Number of changes between two boot clocks, and the time (µs) within which they mean two autopilots."""


class VehicleState:
    """State of the configured vehicle, updated from its messages.

    `clock`: estimate of the autopilot's clock; reset when the autopilot reboots.
    `reboots`: number of reboots of the autopilot.
    `on_reboot`: function that is called at each reboot.
    `state`: presence of the autopilot: ABSENT, OK or LOST.
    """

    def __init__(self, system: int, component: int, autopilot: int, output: Output) -> None:
        self.system, self.component, self.autopilot = system, component, autopilot
        self.clock = VehicleClock()
        self.reboots = 0
        self.on_reboot: Callable[[], object] = int
        self.state = MAG_PORT_STATE.ABSENT
        self._output = output
        self._numbers: dict[int, Numbers] = {}
        self._before: dict[int, tuple[int, int]] = {}  # frames received and lost at the last comparison
        self._boot_ms = self._boot_us = 0
        self._other_clock = 0, 0  # the last boot time (ms) of another clock, and its time of reception (µs)
        self._stamps: dict[int, int] = {}  # the last boot time (ms) of each kind of message
        self._behind = 0
        self._changes: list[int] = []

    @property
    def frames_lost(self) -> int:
        """Number of lost frames of the autopilot, from its sequence numbers."""
        numbers = self._numbers.get(self.autopilot)
        return 0 if numbers is None else numbers.lost

    def receive(self, message: Message, t_us: int) -> bool:
        """Update the state with a message received at `t_us` (µs); return True if it is from our vehicle."""
        if message.system != self.system:
            is_vehicle = message.id == HEARTBEAT and message["autopilot"] != MAV_AUTOPILOT.INVALID
            if is_vehicle and message["type"] != MAV_TYPE.GCS:
                text = f"vehicle {message.system} is on the link too: ignored"
                self._output.announce(f"system {message.system}", text, MAV_SEVERITY.NOTICE)
            return False
        if message.component == self.component:
            text = f"another program sends as {self.system}:{self.component}"
            self._output.announce("twin", text, MAV_SEVERITY.WARNING)
            return False
        self.count(message, t_us)
        if message.component == self.autopilot:
            if (boot_time := spec(message.id).fields.get("time_boot_ms")) is not None:
                self._watch_boot(message.id, boot_time.get(message.payload), t_us)
            elif message.id == HEARTBEAT:
                self._present(t_us)
        return True

    def count(self, message: Message, t_us: int) -> None:
        """Count a frame of the vehicle, which may have an unknown message id or be rejected."""
        if message.system != self.system or message.component == self.component:
            return
        numbers = self._numbers.get(message.component)
        if numbers is None:
            if len(self._numbers) >= WATCHED:
                return
            if not self._numbers:
                self._output.every("losses", LOSS_INTERVAL_US, self._find_losses, t_us + LOSS_INTERVAL_US)
            numbers = self._numbers[message.component] = Numbers(message.sequence)
        numbers.count(message.sequence)

    def _find_losses(self, _: int) -> None:
        """Report each component that has lost many frames since the last call."""
        for component, numbers in self._numbers.items():
            received, lost = self._before.get(component, (0, 0))
            self._before[component] = numbers.received, numbers.lost
            received, lost = numbers.received - received, numbers.lost - lost
            if lost >= LEAST and lost > MANY * (received + lost):
                # a router may forward some frames only to other receivers
                who = f"{self.system}:{component}"
                text = f"{who}: over {MANY:.0%} of its frames missing, or for others"
                self._output.announce(f"losses {component}", text, MAV_SEVERITY.WARNING)
            elif received and not lost:
                self._output.forget(f"losses {component}")

    def _present(self, t_us: int) -> None:
        who = f"autopilot {self.system}:{self.autopilot}"
        if self.state != MAG_PORT_STATE.OK:
            self._output.announce("autopilot", f"{who} found", MAV_SEVERITY.INFO)
        self.state = MAG_PORT_STATE.OK

        def vanish(_: int) -> None:
            self.state = MAG_PORT_STATE.LOST
            self._output.announce("autopilot", f"{who} is silent", MAV_SEVERITY.WARNING)

        self._output.run_once("autopilot", t_us + ABSENT_US, vanish)

    def _watch_boot(self, kind: int, boot_ms: int, t_us: int) -> None:
        """Process the boot time of the message id `kind`, and detect a reboot or a second autopilot.

        Late packets, and messages that are sent long after their time stamp, count as neither. A boot time
        that goes back and continues another clock is not a reboot.
        """
        ahead_ms = _elapsed_ms(boot_ms, self._boot_ms)
        goes_on = _elapsed_ms(boot_ms, self._stamps.setdefault(kind, boot_ms)) >= -BACK_MS
        if goes_on:
            self._stamps[kind] = boot_ms
        if self._boot_us and ahead_ms < -BACK_MS:
            if goes_on and ahead_ms > -LEAP_MS:
                return  # this message is always sent long after its time stamp
            self._behind += 1
            if self._behind < BELIEVED:
                return
            self._behind = 0
            other_ms, other_us = self._other_clock
            self._other_clock = self._boot_ms, self._boot_us
            if other_us and abs(_elapsed_ms(boot_ms, other_ms) - (t_us - other_us) // 1000) <= LEAP_MS:
                self._change(t_us)
            else:
                self._reboot()
        elif self._behind:
            self._behind = 0
            self._change(t_us)
        elif self._boot_us and ahead_ms > (t_us - self._boot_us) // 1000 + LEAP_MS:
            self._other_clock = self._boot_ms, self._boot_us
            self._change(t_us)
        if ahead_ms > 0 or ahead_ms < -BACK_MS or not self._boot_us:
            self._boot_ms, self._boot_us = boot_ms, t_us

    def _reboot(self) -> None:
        """Count and report a reboot, and reset the state before it."""
        self.reboots += 1
        self.clock.reset()
        self.on_reboot()
        self._stamps.clear()
        text = f"autopilot {self.system}:{self.autopilot} rebooted"
        self._output.send_statustext(text, MAV_SEVERITY.WARNING)

    def _change(self, t_us: int) -> None:
        """Count a change of the boot clock at `t_us`; report two autopilots after `TWICE` recent changes."""
        self._changes = [*(when for when in self._changes if t_us - when < CHANGES_US), t_us][-TWICE:]
        if len(self._changes) == TWICE:
            text = f"two autopilots send as {self.system}:{self.autopilot}"
            self._output.announce("autopilots", text, MAV_SEVERITY.WARNING)


def _elapsed_ms(one_ms: int, other_ms: int) -> int:
    """Return ``one_ms - other_ms`` of two boot times as a signed difference modulo 2^32 ms (50 days)."""
    return (one_ms - other_ms + (1 << 31)) % (1 << 32) - (1 << 31)
