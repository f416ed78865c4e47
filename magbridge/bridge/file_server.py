"""File server for stations: a thread reads the files, and the bridge sends them between measurements.

The live thread hands on requests and takes replies, a few messages at a time; it never waits for the disk.
Replies are not in the log, which would grow by everything that is read of it. The log has their number, so
that a replay counts on as the bridge did.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

from magbridge.bridge import events
from magbridge.link.files import FtpServer, LogTransfer, Tree
from magbridge.mavlink import Message, Spec, spec

__all__ = ["FileServer"]

FTP = spec("FILE_TRANSFER_PROTOCOL")
LIST, DATA, END = (spec(f"LOG_REQUEST_{name}").id for name in ("LIST", "DATA", "END"))
REQUESTS = 64
"""Requests that may wait; more are dropped, and stations ask again."""
UNDER_WAY = 32
"""Replies of one station that may be under way."""
BATCH = 4
"""Messages that are sent at once: some 0.1 ms of the live thread."""
READY = 8
"""Messages that may wait to be sent; then nothing more is read."""
POLL_INTERVAL_S = 0.01
"""s between two looks at whether the link takes more."""
IDLE = 1.0
"""s between two looks for requests while nothing is under way."""

Reply = tuple[Spec, bytes]
Sender = tuple[int, int]


class FileServer:
    """Serve the metadata of the parameters, and the logs.

    `texts`: the metadata's files, by path.
    `logs`: the folder of the logs.
    `rate`: returns bytes/s at which files are sent; 0 refuses every request by silence.
    `notify`: wakes the live thread with a state frame, or with none.
    """

    def __init__(
        self,
        texts: Mapping[str, bytes],
        logs: Path | None,
        rate: Callable[[], float],
        notify: Callable[[bytes], None],
    ) -> None:
        tree = Tree(texts, logs)
        self._ftp, self._logs = FtpServer(tree, time.monotonic), LogTransfer(tree)
        self._rate, self._notify = rate, notify
        self._asked: SimpleQueue[Message | None] = SimpleQueue()
        self._ready: deque[tuple[Sender, Reply]] = deque()
        self._ending = False
        self._under_way: dict[Sender, deque[Iterator[Reply]]] = {}
        self._reported: set[str] = set()
        self._thread = Thread(target=self._serve, name="file server", daemon=True)
        self._thread.start()

    def ask(self, request: Message) -> None:
        """Queue a request; return at once."""
        if self._asked.qsize() < REQUESTS:
            self._asked.put(request)

    def drain(self) -> tuple[Sender, list[Reply]]:
        """Return the pending replies and their receiver, at once."""
        sender, replies = (0, 0), list[Reply]()
        while self._ready and len(replies) < BATCH and (not replies or self._ready[0][0] == sender):
            sender, reply = self._ready.popleft()
            replies.append(reply)
        return sender, replies

    def close(self) -> None:
        """End the thread, and close its files."""
        self._ending = True
        self._asked.put(None)
        self._thread.join(IDLE)

    def _serve(self) -> None:
        try:
            while True:
                busy = bool(self._under_way)
                for request in self._waiting(0.0 if busy else IDLE):
                    if request is None:
                        return
                    self._begin(request)
                if self._under_way:
                    self._turn()
        finally:
            self._ftp.close()

    def _waiting(self, timeout: float) -> Iterator[Message | None]:
        """Yield the pending requests, or wait for the first one."""
        try:
            yield self._asked.get(timeout=timeout) if timeout else self._asked.get_nowait()
            for _ in range(self._asked.qsize()):
                yield self._asked.get_nowait()
        except Empty:
            return

    def _begin(self, request: Message) -> None:
        sender = request.system, request.component
        waiting = self._under_way.setdefault(sender, deque(maxlen=UNDER_WAY))
        if request.id == FTP.id:
            replies = self._ftp.handle(sender, request["payload"])
            header = bytes((0, *sender))
            waiting.append((FTP, header + payload) for payload in self._reported_once(sender, replies))
        elif request.id == LIST:
            waiting.append(self._logs.entries(request["start"], request["end"]))
        elif request.id == DATA:
            waiting.append(self._logs.data(request["id"], request["ofs"], request["count"]))
        elif request.id == END:
            waiting.clear()

    def _reported_once(self, sender: Sender, replies: Iterator[bytes]) -> Iterator[bytes]:
        """Yield replies; report the first refusal to a station, other than the end of a file."""
        for payload in replies:
            yield payload
            if why := FtpServer.refusal(payload):
                text = f"file for {sender[0]}:{sender[1]} refused: {why}"
                if text not in self._reported and len(self._reported) < REQUESTS:
                    self._reported.add(text)
                    self._notify(events.notice(text[:50]))

    def _turn(self) -> None:
        """Prepare a batch for each station in turn, and pause as long as sending takes."""
        rate, size = self._rate(), 0
        if rate <= 0:
            self._under_way.clear()
            return
        while len(self._ready) >= READY and not self._ending:  # the link is full, or the live thread busy
            time.sleep(POLL_INTERVAL_S)
            self._notify(b"")
        for _ in range(BATCH):
            if not self._under_way:
                break
            sender = next(iter(self._under_way))
            waiting = self._under_way.pop(sender)
            reply = next(waiting[0], None) if waiting else None
            if reply is None and waiting:
                waiting.popleft()
            if waiting:
                self._under_way[sender] = waiting  # behind the others
            if reply is not None:
                self._ready.append((sender, reply))
                size += len(reply[1])
        if self._ready:
            self._notify(b"")
        time.sleep(size / rate)
