"""Live run of a bridge on its ports, with storage of its state for the next run and a file server.

A thread reads the files that stations request. The live thread passes requests to it and takes a few replies
at a time, so that the live thread never waits for the disk. Replies with files are not logged, because each
download of a log would make the log grow. The log has the number of replies, from which a replay continues
the sequence numbers.
"""

from __future__ import annotations

import gc
import glob
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

import msgspec

from magbridge.bridge import events
from magbridge.bridge.devices import BusPort, SerialPort, sensor_port
from magbridge.bridge.events import HostClock, LiveEdge, StartEvent, port_number
from magbridge.bridge.learning import keep, kept_path
from magbridge.bridge.links import nmea_port, open_link
from magbridge.bridge.pipeline import Pipeline, drive, set_up
from magbridge.bridge.port import Port
from magbridge.config import Config, load
from magbridge.errors import ConfigError, DataError, FormatError, WrongUse
from magbridge.files import atomic_path
from magbridge.link.files import FtpServer, LogTransfer, Tree
from magbridge.logs.tlog import TlogWriter
from magbridge.mavlink import Message, Spec, readable_by_all, spec
from magbridge.mavlink.enums import MAG_PORT_NAME, MAV_SEVERITY
from magbridge.records import Channel

__all__ = ["FileServer", "Keeper", "leave_wrong_devices", "ports", "run"]


def load_state(path: str | Path) -> StartEvent:
    """Return the state in the file at `path`; an empty state if the file does not exist.

    FormatError: the file is not a stored state as JSON.
    """
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=StartEvent)
    except FileNotFoundError:
        return StartEvent()
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FormatError(path, f"kept parameters as JSON: {error}") from error


STAMP_INTERVAL_US = 60_000_000
"""Time between two savings of the signing time stamps, µs."""
SAVE_US = 1_000_000
"""Shortest time between two savings of parameters, µs, because a saving delays the sensors."""


class Keeper:
    """Storage of the bridge's state, while the bridge runs and when it ends."""

    AHEAD = 2 * STAMP_INTERVAL_US // 10
    """Time for which each saving reserves stamps, units of 10 µs: the next run does not reuse them."""

    def __init__(self, config: Config) -> None:
        self._notify: Callable[[bytes], None] = lambda _: None
        # named after the configuration, because the folder may contain another bridge's file
        self._path = config.resolve(config.link.parameters or f"{config.path.stem}.parameters.json")
        self._spoilt = False
        try:
            self._kept = load_state(self._path)
        except (FormatError, OSError):  # the bridge starts without the stored state
            self._kept, self._spoilt = StartEvent(), True
        self._key = config.resolve(config.link.signing_key) if config.link.signing_key else None
        self._saved_us = self._next_try_us = 0
        self._saved_revision: int | None = 0
        self._learned = kept_path(config)

    def attach(self, edge: LiveEdge) -> None:
        """Send later errors of storage as events to `edge`; rename and report a file that cannot be read."""
        self._notify = edge.notify
        if self._spoilt:
            name = self._path.name
            if self._path.is_file():
                with suppress(OSError):
                    self._path.replace(self._path.with_name(f"{name}.damaged"))
            self._notify(events.notice(f"cannot be read, not used: {name}", MAV_SEVERITY.ERROR))
        if self._key is not None and readable_by_all(self._key):
            self._notify(events.notice(f"{self._key.name[-20:]}: every user can read this key"))

    def start(self, time_us: int) -> StartEvent:
        """Return the start event of a run at `time_us` (µs), with the stored state."""
        return msgspec.structs.replace(self._kept, time_us=time_us)

    def save_changes(self, pipeline: Pipeline, time_us: int) -> None:
        """Save a new learned calibration, changed parameters, and, every `STAMP_INTERVAL_US`, time stamps."""
        learning, path = pipeline.learning, self._learned
        if learning is not None and path is not None and (why := keep(learning, path)):
            self._notify(events.notice(why))
        revision = pipeline.component.parameters.revision
        are_stamps_due = self._key is not None and time_us - self._saved_us > STAMP_INTERVAL_US
        if time_us < self._next_try_us or (revision == self._saved_revision and not are_stamps_due):
            return
        is_saved = self.save(pipeline)
        self._saved_revision = revision if is_saved else None  # None: the same parameters are tried again
        self._saved_us = time_us
        self._next_try_us = time_us + (SAVE_US if is_saved else STAMP_INTERVAL_US)

    def save(self, pipeline: Pipeline, *, last: bool = False) -> bool:
        """Write the state if it has changed; return False if this fails, so that the old file remains.

        `last`: True at the end of a run, when no time stamps need be reserved for later frames.
        """
        kept = StartEvent(parameters=pipeline.component.parameters.changed())
        if signing := pipeline.signing:
            stamp = signing.last if last else signing.reserved(pipeline.component.codec.utc_us, self.AHEAD)
            kept = StartEvent(0, kept.parameters, stamp, signing.streams)
        if kept == self._kept:
            return True
        try:
            with atomic_path(self._path) as temporary:
                temporary.write_bytes(msgspec.json.format(msgspec.json.encode(kept), indent=2))
        except OSError as error:
            self._notify(events.notice(f"parameters not kept: {error.strerror or error}"))
            return False
        self._kept = kept
        return True


SWITCH = 0.0005
"""Python's switch interval, s: the time that another thread can delay the bridge. The default is 5 ms."""
NOTICE_PAUSE = 0.2
"""Time between two checks for texts to print, s."""
LOG_CHECK_US = 1_000_000
"""Time between two checks of the log, µs."""


def run(path: Path) -> None:
    """Run the bridge of a ``bridge.toml`` on its ports until a signal stops it.

    STATUSTEXTs are also printed to stderr.

    `path`: path of the ``bridge.toml``.
    ConfigError, FormatError, CalibrationError: the configuration, or a file that it names, is not valid; no
        port was opened.
    """
    if sys.stderr.isatty():
        print(f"{path}: running until Ctrl-C; announcements on the link are repeated here", file=sys.stderr)
    clock = HostClock()
    try:
        config = load(path)
        keeper = Keeper(config)
        pipeline = set_up(config, keeper.start(clock.now_us()))
        opened = ports(config)
    except (ConfigError, DataError) as error:
        error.exit_code = WrongUse.exit_code  # a service restarts the bridge after any other code
        raise
    link, edge = opened[Channel.LINK], LiveEdge(opened, clock)
    keeper.attach(edge)
    keeper.save(pipeline)  # signing stamps are reserved on disk before the first frame uses one
    log = None
    if (limits := config.log) is not None:
        edge.notify(events.port_state(MAG_PORT_NAME.LOG))
        log = TlogWriter(
            config.resolve(limits.directory), max_size=limits.max_size, max_age=limits.max_age,
            header=pipeline.declarations,
        )  # fmt: skip
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:  # as SIGHUP is under nohup
            signal.signal(number, lambda *_: edge.stop())
    # after the signal handlers are set, because a program may send a signal when it reads the first text
    texts = pipeline.component.output.texts
    Thread(target=_print_statustexts, args=(texts,), name="voice", daemon=True).start()
    sys.setswitchinterval(SWITCH)
    # These objects live as long as the process, so the collector need not scan them. A collection before
    # would delay the first heartbeat by 20 ms and free only 0.1 MB.
    gc.freeze()
    gc.enable()
    component, folder = pipeline.component, config.resolve(config.log.directory) if config.log else None
    parameters = component.parameters
    files = FileServer(component.metadata, folder, lambda: 1e3 * parameters["MB_FILE_RATE"], edge.notify)
    monitor = LogMonitor(log, pipeline, edge) if log is not None else None

    def finish_event(time_us: int) -> None:
        while component.file_requests:
            files.ask(component.file_requests.popleft())
        if not link.waiting:
            station, messages = files.drain()
            if messages:
                edge.answer(station, pipeline.interleaved(messages))
        keeper.save_changes(pipeline, time_us)
        if monitor is not None:
            monitor.check(time_us)
        leave_wrong_devices(pipeline, opened)

    try:
        drive(pipeline, edge, log, finish_event)
    finally:
        keeper.save(pipeline, last=True)
        files.close()
        edge.close()
        if log is not None:
            log.close()


def leave_wrong_devices(pipeline: Pipeline, ports: Mapping[int, Port]) -> None:
    """For each sensor on whose port another instrument seems to send, switch to the next matching device."""
    for stream in pipeline.streams:
        if stream.wrong_device:
            stream.wrong_device = False
            ports[port_number(stream.sensor_id)].move_on()


def ports(config: Config) -> dict[int, Port]:
    """Return the (unopened) ports of the link, of the sensors and of NMEA sentences, by MAG_PORT_NAME.

    The link is the first, so that the bridge can report another port that does not open.

    ConfigError: a port's name is not valid, or two ports are one device.
    """
    own = config.link
    link = open_link(
        own.url,
        own.baudrate,
        str(config.path),
        autopilot=(own.system, own.autopilot),
        budget=1e3 * own.max_other_peers_rate,
        signed=own.signing_key is not None,
    )
    opened: dict[int, Port] = {Channel.LINK: link}
    opened |= {port_number(one.id or 0): sensor_port(one, config.path) for one in config.sensors}
    if (nmea := nmea_port(config)) is not None:
        opened[MAG_PORT_NAME.NMEA] = nmea
    keys = "link.url", *(f"{one.key}.port" for one in config.sensors), "heading.nmea"
    used = dict[str, str]()
    for key, port in zip(keys, opened.values(), strict=False):
        is_local = isinstance(port, SerialPort | BusPort) and "://" not in port.name
        if is_local and not glob.has_magic(port.name):
            other = used.setdefault(os.path.realpath(port.name), key)
            if other != key:
                raise ConfigError(
                    config.path, key, f"expected another device than {other}, got {port.name!r}"
                )
    return opened


def _print_statustexts(texts: deque[tuple[MAV_SEVERITY, str]]) -> None:
    """Print `texts` (severity and text) to stderr, in a thread: a blocked terminal then stops nothing.

    ``os.write`` is used, because Python waits at exit for a file object that is in use. In the journal, the
    prefix ``<N>`` sets the syslog level, which is equal to the MAVLink severity (sd-daemon(3)).
    """
    stderr = sys.stderr.fileno()
    status = os.fstat(stderr)
    to_journal = os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
    while True:
        while texts:
            severity, text = texts.popleft()
            prefix = f"<{severity:d}>" if to_journal else "magbridge: "
            with suppress(OSError):  # stderr is closed, or the disk is full
                os.write(stderr, f"{prefix}{text}\n".encode())
        time.sleep(NOTICE_PAUSE)


class LogMonitor:
    """Reporter of failures, recoveries and losses of the log, which also updates its records of the start."""

    def __init__(self, log: TlogWriter, pipeline: Pipeline, edge: LiveEdge) -> None:
        self._log, self._pipeline, self._edge = log, pipeline, edge
        self._reported, self._check_us = ("", 0), 0

    def check(self, time_us: int) -> None:
        """Report changes of the log's state, at most once in `LOG_CHECK_US`, at `time_us` (µs)."""
        if time_us < self._check_us:
            return
        self._check_us = time_us + LOG_CHECK_US
        self._log.beginning = self._pipeline.beginning(self._pipeline.component.parameters.changed())
        state = self._log.failure, self._log.lost
        if state != self._reported:
            self._reported = state
            self._edge.notify(events.port_state(MAG_PORT_NAME.LOG, *state))


FTP = spec("FILE_TRANSFER_PROTOCOL")
LIST, DATA, END = (spec(f"LOG_REQUEST_{name}").id for name in ("LIST", "DATA", "END"))
REQUESTS = 64
"""Most requests that wait; further requests are dropped, and stations repeat them."""
UNDER_WAY = 32
"""Most requests of one station that are processed at a time."""
BATCH = 4
"""Most messages that are sent at once, which takes about 0.1 ms of the live thread."""
READY = 8
"""Most messages that wait to be sent; then no file is read."""
POLL_INTERVAL_S = 0.01
"""Time between two checks if the link accepts more messages, s."""
CLOSE_S = 1.0
"""Longest wait for the end of the thread, s."""

Reply = tuple[Spec, bytes]
Sender = tuple[int, int]


class FileServer:
    """Thread that serves the metadata of the parameters, and the logs, to stations.

    `texts`: contents of the metadata files, by path.
    `logs`: the folder of the logs; None without a log.
    `rate`: returns the rate at which files are sent, bytes/s; at 0, requests get no reply.
    `notify`: wakes the live thread; called with a state frame or with empty bytes.
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
        """Queue a request without blocking."""
        if self._asked.qsize() < REQUESTS:
            self._asked.put(request)

    def drain(self) -> tuple[Sender, list[Reply]]:
        """Return up to `BATCH` ready replies and their receiver (system, component), without blocking."""
        sender, replies = (0, 0), list[Reply]()
        while self._ready and len(replies) < BATCH and (not replies or self._ready[0][0] == sender):
            sender, reply = self._ready.popleft()
            replies.append(reply)
        return sender, replies

    def close(self) -> None:
        """End the thread, which closes its files."""
        self._ending = True
        self._asked.put(None)
        self._thread.join(CLOSE_S)

    def _serve(self) -> None:
        try:
            while not self._ending:
                with suppress(Empty):  # while requests are under way, wait for no further request
                    while (request := self._asked.get(block=not self._under_way)) is not None:
                        self._begin(request)
                if self._under_way:
                    self._prepare_replies()
        finally:
            self._ftp.close()

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
        """Yield the replies; report each kind of rejection once per station, except the end of a file."""
        for payload in replies:
            yield payload
            if why := FtpServer.refusal(payload):
                text = f"file for {sender[0]}:{sender[1]} refused: {why}"
                if text not in self._reported and len(self._reported) < REQUESTS:
                    self._reported.add(text)
                    self._notify(events.notice(text[:50]))

    def _prepare_replies(self) -> None:
        """Prepare a batch of replies, one per station in turn, and pause for the time that sending takes."""
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
