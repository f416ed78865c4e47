"""Peers of a link that accepts connections: ``udpin`` or ``tcpin``.

Each peer has a parser of its own, so that what one sends never swallows what another does: the bridge gets
whole frames, and after them the bytes that belong to none. A peer is answered once it has sent something
valid, signed where the link is signed; a peer with the autopilot's id is answered first and is never left out
for the others.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Hashable, Iterable
from math import inf

from magbridge.mavlink import BAD_DATA, Codec
from magbridge.mavlink.framing import V2

__all__ = ["ANSWERED", "PEER_READ_BYTES", "TIMEOUT", "Peer", "Peers"]

TIMEOUT = 30.0
"""s after its last valid frame at which a peer is no longer answered."""
ANSWERED = 8
"""Most peers that are answered; of more, the autopilot's and then those that came first."""
MAX_PARSED_PEERS = 64
"""Most peers of which there is a parser."""
PEER_READ_BYTES = 8192
"""Bytes of one peer that are looked at before the sensor's turn; the autopilot's are looked at whole."""
STRANGERS = 8192
"""Bytes, likewise, of all peers together that have not yet sent anything valid."""
LOOK = 1.0
"""s between two looks at who has fallen silent."""


class Peer:
    """A network peer of a port.

    Attributes
    ----------
    address : hashable
        As the port knows it.
    genuine, pilot : float
        When it last sent something valid, and something of the autopilot's; s, monotonic.
    """

    __slots__ = ("address", "codec", "genuine", "pilot", "share", "since")

    def __init__(self, address: Hashable) -> None:
        self.address, self.codec = address, Codec(0, 0)
        self.genuine = self.pilot = self.since = -inf
        self.share = 0


class Peers:
    """The peers of one port.

    Parameters
    ----------
    autopilot : (int, int) or None
        System and component whose peer goes before all others.
    budget : float
        Bytes/s that all but the autopilot's get together.
    signed : bool
        A frame is valid once :meth:`credit` has named it; else if it is a known message.

    Attributes
    ----------
    ignored, withheld : int
        Bytes that were not parsed, because their sender had used up its share; and that others than the
        autopilot did not get, because the budget was used up.
    notices : deque of str
        Texts about the peers to announce, each once.
    """

    def __init__(
        self, autopilot: tuple[int, int] | None = None, *, budget: float = inf, signed: bool = False
    ) -> None:
        self._autopilot, self._signed = autopilot, signed
        self._budget = self._purse = budget
        self._paid = time.monotonic()
        self._peers: dict[Hashable, Peer] = {}
        self._frames: list[bytes] = []
        self._stray: list[bytes] = []
        self._authors: dict[bytes, Peer] = {}
        self._routes: dict[tuple[int, int], Peer] = {}  # at most 65,536
        self._strangers = 0
        self._answered: list[Peer] = []
        self._look = 0.0
        self._reported: set[str] = set()
        self.ignored = self.withheld = 0
        self.notices: deque[str] = deque(maxlen=8)

    def receive(self, address: Hashable, data: bytes) -> None:
        """Process the bytes that a peer sent."""
        peer, now = self._peers.get(address), time.monotonic()
        if peer is None:
            peer = self._meet(address)
        known = now - peer.genuine < TIMEOUT
        peer.share += len(data)
        self._strangers += 0 if known else len(data)
        if now - peer.pilot > TIMEOUT and (
            peer.share > PEER_READ_BYTES or (not known and self._strangers > STRANGERS)
        ):
            self.ignored += len(data)
            return
        for message in peer.codec.parse(data):
            if message.id == BAD_DATA:
                self._stray.append(message.frame)
                continue
            self._frames.append(message.frame)
            if self._signed:
                self._authors.setdefault(message.frame, peer)
            elif message.known:
                self._prove(peer, message.frame, now)

    def drain(self) -> bytes:
        """Return the bytes received since the last call: first the frames, then bytes outside of frames."""
        data = b"".join(self._frames + self._stray)
        self._frames, self._stray, self._strangers = [], [], 0
        for peer in self._peers.values():
            peer.share = 0
        return data

    def credit(self, frames: Iterable[bytes]) -> None:
        """Learn which frames of the last :meth:`drain` were signed by someone who has the key."""
        now = time.monotonic()
        for frame in frames:
            if peer := self._authors.get(frame):
                self._prove(peer, frame, now)
        self._authors.clear()

    def forget(self, address: Hashable) -> None:
        """Remove a peer that has left."""
        self._peers.pop(address, None)
        self._look = 0.0

    def is_known(self, address: Hashable) -> bool:
        """Return True if a peer has lately sent something valid."""
        peer = self._peers.get(address)
        return peer is not None and time.monotonic() - peer.genuine < TIMEOUT

    def answered(self) -> list[Peer]:
        """Return the receivers in the order of sending."""
        now = time.monotonic()
        if now < self._look:
            return self._answered
        self._look = now + LOOK
        valid = [peer for peer in self._peers.values() if now - peer.genuine < TIMEOUT]
        valid.sort(key=lambda peer: (now - peer.pilot > TIMEOUT, peer.since))
        self._answered = valid[:ANSWERED]
        pilots = sum(now - peer.pilot < TIMEOUT for peer in valid)
        self._notify(f"more than {ANSWERED} peers: the others are not answered", len(valid) > ANSWERED)
        self._notify("the autopilot sends from several addresses", pilots > 1)
        return self._answered

    def affords(self, peer: Peer | None, size: int) -> bool:
        """Return True if `size` bytes may go to a peer (None: one that has sent nothing), and count them."""
        now = time.monotonic()
        if self._budget == inf or (peer is not None and now - peer.pilot < TIMEOUT):
            return True
        self._purse = min(self._purse + (now - self._paid) * self._budget, self._budget)  # of a second
        self._paid = now
        if size > self._purse:
            self.withheld += size
            self._notify(f"others get {self._budget / 1e3:g} kB/s in all: link.max_other_peers_rate", True)
            return False
        self._purse -= size
        return True

    def route(self, sender: tuple[int, int]) -> Peer | None:
        """Return the peer from which a system and component was last heard, if it is answered."""
        peer = self._routes.get(sender)
        return peer if peer in self.answered() else None

    def _meet(self, address: Hashable) -> Peer:
        if len(self._peers) >= MAX_PARSED_PEERS:
            least = min(self._peers.values(), key=lambda peer: (peer.pilot, peer.genuine))
            del self._peers[least.address]
        peer = self._peers[address] = Peer(address)
        return peer

    def _prove(self, peer: Peer, frame: bytes, now_s: float) -> None:
        if now_s - peer.genuine > TIMEOUT:
            peer.since, self._look = now_s, 0.0
        peer.genuine = now_s
        who = (frame[5], frame[6]) if frame[0] == V2 else (frame[3], frame[4])
        self._routes[who] = peer
        if who == self._autopilot:
            if now_s - peer.pilot > TIMEOUT:
                self._look = 0.0
            peer.pilot = now_s

    def _notify(self, text: str, holds: bool) -> None:
        """Note a text once, when it begins to hold."""
        if holds and text not in self._reported:
            self.notices.append(text)
        (self._reported.add if holds else self._reported.discard)(text)
