"""Ports that read and write without blocking, and the network peers of a port.

A lost port raises :class:`PortError` once and is closed; :meth:`Port.open` may then be tried again. Writing
never blocks. Messages for a slow reader wait for a short time; then they are dropped and counted.

Each peer of ``udpin`` or ``tcpin`` has its own parser, so that bytes of one peer never damage frames of
another. The bridge gets complete frames, followed by bytes that belong to no frame. The bridge sends to a
peer after the peer has sent a valid frame, which must be signed on a signed link. A peer with the autopilot's
id comes first.
"""

from __future__ import annotations

import errno
import os
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Hashable, Iterable, Iterator
from math import inf
from typing import Any, NamedTuple

from magbridge.errors import PortError
from magbridge.link.publish import LIMITS
from magbridge.mavlink import BAD_DATA, Codec, spec
from magbridge.mavlink.messages import SIGNATURE, V2, is_signed

__all__ = ["PEER_READ_BYTES", "READ_BYTES", "PacedPort", "Peer", "Peers", "Port", "cut", "reason_of"]

PEER_SILENCE_S = 30.0
"""Time after its last valid frame for which the bridge sends to a peer, s."""
MAX_RECEIVERS = 8
"""Most peers to which the bridge sends: the autopilot's peer, then the peers that came first."""
MAX_PARSED_PEERS = 64
"""Most peers that have a parser."""
PEER_READ_BYTES = 8192
"""Most bytes of one peer, except the autopilot's, that are parsed before the sensors are read."""
UNKNOWN_READ_BYTES = 8192
"""Most bytes of all peers without a valid frame together that are parsed before the sensors are read."""
SELECTION_INTERVAL_S = 1.0
"""Time between two updates of the list of peers to which the bridge sends, s."""


class Peer:
    """Network peer of a port.

    `address`: address or descriptor by which the port identifies the peer.
    `codec`: parser of the peer's bytes.
    `valid_s`, `autopilot_s`: times of its last valid frame, and of its last frame of the autopilot; s,
        monotonic.
    `first_valid_s`: time of its first valid frame, without a later silence of `PEER_SILENCE_S`; s, monotonic.
    `unread`: number of bytes received since the bytes of all peers were last drained.
    """

    __slots__ = ("address", "autopilot_s", "codec", "first_valid_s", "unread", "valid_s")

    def __init__(self, address: Hashable) -> None:
        self.address, self.codec = address, Codec(0, 0)
        self.valid_s = self.autopilot_s = self.first_valid_s = -inf
        self.unread = 0


class Peers:
    """All network peers of one port, with the selection of the peers to which the bridge sends.

    `autopilot`: system and component whose peer comes first.
    `budget`: bytes/s that all other peers get together.
    `signed`: True if a frame is valid only after :meth:`credit` confirms it; else each known message is
    valid.
    `notices`: texts about the peers that the bridge shall send as STATUSTEXT.
    """

    def __init__(
        self, autopilot: tuple[int, int] | None = None, *, budget: float = inf, signed: bool = False
    ) -> None:
        self._autopilot, self._signed = autopilot, signed
        self._budget = self._allowance = budget
        self._allowance_s = time.monotonic()
        self._peers: dict[Hashable, Peer] = {}
        self._frames: list[bytes] = []
        self._other_bytes: list[bytes] = []
        self._unconfirmed: dict[bytes, Peer] = {}
        self._routes: dict[tuple[int, int], Peer] = {}  # at most 65,536
        self._unknown_bytes = 0
        self._receivers: list[Peer] = []
        self._selection_s = 0.0
        self._reported: set[str] = set()
        self.notices: deque[str] = deque(maxlen=8)

    def receive(self, address: Hashable, data: bytes) -> None:
        """Process bytes from the peer at `address`."""
        peer, now = self._peers.get(address), time.monotonic()
        if peer is None:
            peer = Peer(address)
            self._add(peer)
        known = now - peer.valid_s < PEER_SILENCE_S
        peer.unread += len(data)
        self._unknown_bytes += 0 if known else len(data)
        if now - peer.autopilot_s > PEER_SILENCE_S and (
            peer.unread > PEER_READ_BYTES or (not known and self._unknown_bytes > UNKNOWN_READ_BYTES)
        ):
            return
        for message in peer.codec.parse(data):
            if message.id == BAD_DATA:
                self._other_bytes.append(message.frame)
                continue
            self._frames.append(message.frame)
            if self._signed:
                self._unconfirmed.setdefault(message.frame, peer)
            elif message.known:
                self._record_valid(peer, message.frame, now)

    def drain(self) -> bytes:
        """Return the bytes received since the last call: first the frames, then bytes outside of frames."""
        data = b"".join(self._frames + self._other_bytes)
        self._frames, self._other_bytes, self._unknown_bytes = [], [], 0
        for peer in self._peers.values():
            peer.unread = 0
        return data

    def credit(self, frames: Iterable[bytes]) -> None:
        """Count `frames` of the last :meth:`drain` as valid for their senders: the key signed them."""
        now = time.monotonic()
        for frame in frames:
            if peer := self._unconfirmed.get(frame):
                if peer.address not in self._peers:  # replaced before the signature was checked
                    self._add(peer)
                self._record_valid(peer, frame, now)
        self._unconfirmed.clear()

    def forget(self, address: Hashable) -> None:
        """Remove a peer that has left."""
        self._peers.pop(address, None)
        self._selection_s = 0.0

    def is_known(self, address: Hashable) -> bool:
        """Return True if the peer at `address` has sent a valid frame within `PEER_SILENCE_S`."""
        peer = self._peers.get(address)
        return peer is not None and time.monotonic() - peer.valid_s < PEER_SILENCE_S

    def receivers(self) -> list[Peer]:
        """Return the peers to which the bridge sends, in the order of sending."""
        now = time.monotonic()
        if now < self._selection_s:
            return self._receivers
        self._selection_s = now + SELECTION_INTERVAL_S
        valid = [peer for peer in self._peers.values() if now - peer.valid_s < PEER_SILENCE_S]
        valid.sort(key=lambda peer: (now - peer.autopilot_s > PEER_SILENCE_S, peer.first_valid_s))
        self._receivers = valid[:MAX_RECEIVERS]
        autopilots = sum(now - peer.autopilot_s < PEER_SILENCE_S for peer in valid)
        text = f"more than {MAX_RECEIVERS} peers: the others are not answered"
        self._notify(text, len(valid) > MAX_RECEIVERS)
        self._notify("the autopilot sends from several addresses", autopilots > 1)
        return self._receivers

    def affords(self, peer: Peer | None, size: int) -> bool:
        """Return True if the budget allows to send `size` bytes to a peer, and subtract them from the budget.

        `peer`: the peer, or None for a peer that has sent nothing.
        """
        now = time.monotonic()
        if self._budget == inf or (peer is not None and now - peer.autopilot_s < PEER_SILENCE_S):
            return True
        gained = (now - self._allowance_s) * self._budget
        self._allowance, self._allowance_s = min(self._allowance + gained, self._budget), now  # of a second
        if size > self._allowance:
            self._notify(f"others get {self._budget / 1e3:g} kB/s in all: link.max_other_peers_rate", True)
            return False
        self._allowance -= size
        return True

    def route(self, sender: tuple[int, int]) -> Peer | None:
        """Return the peer that last sent frames of a system and component; None if it gets none."""
        peer = self._routes.get(sender)
        return peer if peer in self.receivers() else None

    def _add(self, peer: Peer) -> None:
        """Add a peer; if there are too many, remove one to which the bridge does not send."""
        if len(self._peers) >= MAX_PARSED_PEERS:
            receivers = self.receivers()
            others = [other for other in self._peers.values() if other not in receivers]
            del self._peers[min(others, key=lambda other: (other.autopilot_s, other.valid_s)).address]
        self._peers[peer.address] = peer

    def _record_valid(self, peer: Peer, frame: bytes, now_s: float) -> None:
        """Count a valid frame of a peer at `now_s`, and store the peer as the route to the frame's sender."""
        if now_s - peer.valid_s > PEER_SILENCE_S:
            peer.first_valid_s, self._selection_s = now_s, 0.0
        peer.valid_s = now_s
        sender = (frame[5], frame[6]) if frame[0] == V2 else (frame[3], frame[4])
        self._routes[sender] = peer
        if sender == self._autopilot:
            if now_s - peer.autopilot_s > PEER_SILENCE_S:
                self._selection_s = 0.0
            peer.autopilot_s = now_s

    def _notify(self, text: str, holds: bool) -> None:
        """Add `text` to the notices once, when the condition `holds` becomes true."""
        if holds and text not in self._reported:
            self.notices.append(text)
        (self._reported.add if holds else self._reported.discard)(text)


READ_BYTES = 65536
"""Most bytes that are read at once."""
MAX_WAIT_S = 0.1
"""Time after which a waiting message is dropped if a newer message of its kind waits, s."""
MAX_WAITING_MESSAGES = 512
"""Most messages that wait."""
RENEWED = {spec(name).id for name in LIMITS}
"""Ids of periodic messages, of which only the newest matters."""
NAMED, NAME = spec("NAMED_VALUE_FLOAT").id, 8
"""Id of the message in which each name is a kind of its own, and the offset of the name in its payload."""
HEADER, CHECKSUM = 10, 2
"""Bytes of a frame before its payload, and of its checksum after the payload."""


class Port(ABC):
    """Port with one file descriptor: of a file, a terminal, a socket or a pipe.

    `peers`: the peers of a port with any number of peers; None for a port with one peer.
    `read_bytes`: most bytes that are read at once.
    `ended`: reason of the :class:`PortError` at an end of file.
    """

    def __init__(
        self, name: str, peers: Peers | None = None, *, read_bytes: int = READ_BYTES, ended: str = "hung up"
    ) -> None:
        self.name = name
        self._peers, self._read_bytes, self._ended = peers, read_bytes, ended
        self._fd = -1  # set last when the port opens, which another thread may do
        self.dropped = 0
        """Number of bytes that could not be written."""
        self.overrun = 0
        """Number of the `dropped` bytes that an open port could not buffer, because it is too slow."""

    @property
    def is_open(self) -> bool:
        """True if bytes can be read and written."""
        return self._fd >= 0

    def open(self) -> None:
        """Open the port; raise :class:`PortError` if this fails."""
        try:
            self._fd = self._open()
        except (OSError, ValueError) as error:  # includes pyserial's SerialException
            raise PortError(self.name, reason_of(error)) from error

    @abstractmethod
    def _open(self) -> int:
        """Open the port and return its descriptor; raise OSError or ValueError if this fails."""

    def move_on(self) -> None:
        """Close the port, which is then opened again; for a pattern, with the next matching device."""
        self.close()

    def fds(self) -> list[int]:
        """Return the file descriptors to wait for."""
        return [self._fd] if self._fd >= 0 else []

    def read(self) -> bytes:
        """Return the received bytes; raise :class:`PortError` if the port is lost.

        Call this method only if a descriptor is ready, because a serial line without bytes counts as lost.
        """
        received = self._receive()
        if self._peers is None:
            return b"".join(data for _, data in received)
        for address, data in received:
            self._peers.receive(address, data)
        return self._peers.drain()

    def _receive(self) -> list[tuple[Any, bytes]]:
        """Return the received pieces of data, each with the address of its sender."""
        try:
            data = os.read(self._fd, self._read_bytes)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self.lost(error.strerror) from error
        if not data:
            raise self.lost(self._ended)
        return [(None, data)]

    def write(self, data: bytes) -> None:
        """Send or drop each message in `data` as a whole; raise :class:`PortError` if the port is lost."""
        if self._peers is None:
            self._send(data, None)
            return
        for address, peer in self._receivers():
            if self._peers.affords(peer, len(data)):
                self._send(data, address)

    def write_to(self, sender: tuple[int, int], data: bytes) -> None:
        """Send as :meth:`write`, but only to the peer that last sent frames of a system and component."""
        if self._peers is None:
            self._send(data, None)
        elif (peer := self._peers.route(sender)) is not None and self._peers.affords(peer, len(data)):
            self._send(data, peer.address)

    def _receivers(self) -> list[tuple[Any, Peer | None]]:
        """Return address and peer of each receiver, in the order of sending."""
        assert self._peers is not None
        return [(peer.address, peer) for peer in self._peers.receivers()]

    @abstractmethod
    def _send(self, data: bytes, address: Any) -> None:
        """Send `data` to the peer at `address`, or, if `address` is None, to the port's only peer."""

    @property
    def waiting(self) -> bool:
        """True if bytes wait because the line is slow."""
        return False

    def flush(self) -> None:  # noqa: B027 - most ports keep nothing
        """Send more of the waiting bytes; raise :class:`PortError` if the port is lost."""

    def blocked(self) -> list[int]:
        """Return the file descriptors for which bytes wait until the descriptor is writable."""
        return []

    def credit(self, frames: Iterable[bytes]) -> None:
        """Accept the senders of `frames`, which were signed with the key, as receivers."""
        if self._peers is not None:
            self._peers.credit(frames)

    def notice(self) -> str:
        """Remove and return the oldest notice about the peers; empty if none waits."""
        return self._peers.notices.popleft() if self._peers is not None and self._peers.notices else ""

    def write_all(self, data: bytes) -> None:
        """Send all of `data` and wait for a slow reader; for a replay, which has no deadline."""
        self.write(data)

    @abstractmethod
    def close(self) -> None:
        """Close the port, if it is open."""

    def overran(self, data: bytes) -> None:
        """Count `data` as dropped because the line is too slow."""
        self.dropped += len(data)
        self.overrun += len(data)

    def lost(self, reason: object) -> PortError:
        """Close the port because of `reason`, and return the error for the caller to raise."""
        self.close()
        return PortError(self.name, str(reason))


def reason_of(error: Exception) -> str:
    """Return why a port did not open, without the port's name, so that the text fits a STATUSTEXT."""
    beneath = error.__context__ if isinstance(error.__context__, OSError) else error
    if isinstance(beneath, OSError) and beneath.errno == errno.EAGAIN:
        return "in use by another program"
    return getattr(beneath, "strerror", None) or str(error)


class PacedPort(Port):
    """Port whose line may be slower than the data to send.

    Excess messages wait in the port, which can still drop them, and not in the system's buffers, which would
    send them seconds late. The order of messages never changes, because signatures and sequence numbers
    depend on it.

    `piece`: number of bytes that are written to the system at once, before a message is completed.
    """

    def __init__(
        self, name: str, piece: int, *, read_bytes: int = READ_BYTES, ended: str = "hung up"
    ) -> None:
        super().__init__(name, read_bytes=read_bytes, ended=ended)
        self._piece = piece
        self._waiting: deque[_Waiting] = deque()
        self._begun = bytearray()

    def _send(self, data: bytes, address: Any) -> None:  # noqa: ARG002 - a line has one peer
        """Send the messages in `data`, or queue them; if too many wait, drop older ones as a whole."""
        free = not self.waiting and len(data) <= self._piece
        if free and self._room():  # the usual case, in which data need not be split into messages
            self._begun += data[self._put(data) :]
            return
        now = time.monotonic()
        self._waiting.extend(_Waiting(now, _kind(frame), frame) for frame in cut(data))
        self.flush()
        if len(self._waiting) > MAX_WAITING_MESSAGES:
            self._thin(now)
            while len(self._waiting) > MAX_WAITING_MESSAGES // 2:
                self.overran(self._waiting.popleft().frame)

    @property
    def waiting(self) -> bool:
        """True if a message, or the rest of a message, waits."""
        return bool(self._begun or self._waiting)

    def flush(self) -> None:
        """Send as much pending data as the line accepts."""
        while self.waiting and self._room():
            if not self._begun:
                self._begin()
            del self._begun[: self._put(self._begun)]

    def blocked(self) -> list[int]:
        """Return the port's descriptor, for which bytes may wait."""
        return self.fds()

    @abstractmethod
    def _room(self) -> bool:
        """Return True if the system would transmit further bytes without a long delay."""

    def _put(self, data: bytes | bytearray) -> int:
        """Write `data`; return the number of bytes written. PortError: the port is lost."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise self.lost(error.strerror) from error

    def _forget(self) -> None:
        """Discard the pending data of a lost line."""
        self._waiting.clear()
        self._begun.clear()

    def _begin(self) -> None:
        """Start to send the next piece of the waiting bytes."""
        late = time.monotonic() - MAX_WAIT_S
        if self._waiting[0].since < late:
            self._thin(late)
        while self._waiting and len(self._begun) < self._piece:
            self._begun += self._waiting.popleft().frame

    def _thin(self, late: float) -> None:
        """Drop messages that wait since before `late` (s, monotonic) if a newer message of the kind waits."""
        newer: set[bytes] = set()
        kept: deque[_Waiting] = deque()
        for one in reversed(self._waiting):
            if one.kind in newer and one.since < late:
                self.overran(one.frame)
                continue
            kept.appendleft(one)
            if one.kind is not None:
                newer.add(one.kind)
        self._waiting = kept


class _Waiting(NamedTuple):
    """Waiting message: begin of the wait (s, monotonic), kind by :func:`_kind`, and bytes."""

    since: float
    kind: bytes | None
    frame: bytes


def cut(data: bytes) -> Iterator[bytes]:
    """Yield the MAVLink frames in `data`; yield other data, such as a sensor command, whole."""
    while data:
        size = len(data)
        if data[0] == V2 and size > HEADER:
            size = HEADER + data[1] + CHECKSUM + (SIGNATURE if is_signed(data) else 0)
        yield data[:size]
        data = data[size:]


def _kind(frame: bytes) -> bytes | None:
    """Return a key equal for all messages that replace each other; None for a message that must be sent."""
    number = int.from_bytes(frame[7:10], "little")
    if frame[0] != V2 or number not in RENEWED:
        return None
    return frame[7:10] + (frame[HEADER + NAME : HEADER + frame[1]] if number == NAMED else b"")
