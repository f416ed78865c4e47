"""State between runs of a bridge: parameters set over the link, time stamps, learned calibrations."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from magbridge.bridge import states
from magbridge.bridge.events import StartEvent
from magbridge.bridge.learning import keep, kept_path
from magbridge.bridge.live import LiveEdge
from magbridge.bridge.pipeline import Pipeline
from magbridge.config import Config
from magbridge.errors import FormatError
from magbridge.files import atomic_path
from magbridge.mavlink import readable_by_all
from magbridge.mavlink.enums import MAV_SEVERITY

__all__ = ["Keeper", "StoredState", "load_state", "save_state"]

Byte = Annotated[int, Meta(ge=0, le=255)]


class StoredState(msgspec.Struct, frozen=True):
    """The contents of the file."""

    parameters: dict[str, Annotated[float, Meta(ge=-3e38, le=3e38)]] = {}
    """Values that differ from the configuration's."""
    signing_timestamp: Annotated[int, Meta(ge=0, lt=1 << 47)] = 0
    """The last that may have been used (10 µs since 2015-01-01); 48 bits on the link."""
    signing_streams: list[tuple[Byte, Byte, Byte, bool, Annotated[int, Meta(ge=0, lt=1 << 48)]]] = []
    """The last time stamp accepted of each stream."""


def load_state(path: str | Path) -> StoredState:
    """Read the file; return an empty state if it does not exist.

    FormatError: it is not what :func:`save_state` wrote.
    """
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=StoredState)
    except FileNotFoundError:
        return StoredState()
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FormatError(path, f"kept parameters as JSON: {error}") from error


def save_state(path: str | Path, kept: StoredState) -> None:
    """Write the file, whole or not at all, and sync it to the disk: power may be cut at any moment."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(kept), indent=2))


STAMP_INTERVAL_US = 60_000_000
"""µs between two savings of the signing time stamps."""
SAVE_US = 1_000_000
"""µs between two savings of parameters: each waits for the disk, and the sensor for it."""


class Keeper:
    """Save the state while the bridge runs and when it ends."""

    AHEAD = 2 * STAMP_INTERVAL_US // 10
    """Units of 10 µs for which stamps are reserved at each saving, lest the next run use them again."""

    def __init__(self, config: Config) -> None:
        self._notify: Callable[[bytes], None] = lambda _: None
        # named after the configuration: the folder may hold another bridge's file
        self._path = config.resolve(config.link.parameters or f"{config.path.stem}.parameters.json")
        self._spoilt = False
        try:
            self._kept = load_state(self._path)
        except (FormatError, OSError):  # no reason to keep a vehicle ashore
            self._kept, self._spoilt = StoredState(), True
        self._key = config.resolve(config.link.signing_key) if config.link.signing_key else None
        self._saved_us = self._retry_us = self._revision = 0
        self._learned = kept_path(config)

    def attach(self, edge: LiveEdge) -> None:
        """Attach `edge`, to notify it when the state cannot be stored or read; then the file is set aside."""
        self._notify = edge.notify
        if self._spoilt:
            name = self._path.name
            if self._path.is_file():
                with suppress(OSError):
                    self._path.replace(self._path.with_name(f"{name}.damaged"))
            self._notify(states.notice(f"cannot be read, not used: {name}", MAV_SEVERITY.ERROR))
        if self._key is not None and readable_by_all(self._key):
            self._notify(states.notice(f"{self._key.name[-20:]}: every user can read this key"))

    def start(self, time_us: int) -> StartEvent:
        """Return the start of a run at `time_us`."""
        kept = self._kept
        return StartEvent(time_us, kept.parameters, kept.signing_timestamp, kept.signing_streams)

    def look(self, pipeline: Pipeline, time_us: int) -> None:
        """Save the learned calibration, changed parameters within `SAVE_US`, time stamps every `KEEP_US`."""
        learning, path = pipeline.learning, self._learned
        if learning is not None and path is not None and (why := keep(learning, path)):
            self._notify(states.notice(why))
        revision = pipeline.component.parameters.revision
        due = self._key is not None and time_us - self._saved_us > STAMP_INTERVAL_US
        if time_us < self._retry_us or (revision == self._revision and not due):
            return
        self._revision, self._saved_us, self._retry_us = revision, time_us, time_us + SAVE_US
        if not self.save(pipeline):
            self._revision, self._retry_us = -1, time_us + STAMP_INTERVAL_US

    def save(self, pipeline: Pipeline, *, last: bool = False) -> bool:
        """Write the file if its content has changed; return False, the old file kept, where that fails.

        At the `last` saving of a run, no stamp is reserved for frames still to be sent.
        """
        kept = StoredState(pipeline.component.parameters.changed())
        if signing := pipeline.signing:
            stamp = signing.last if last else signing.reserved(pipeline.component.codec.utc_us, self.AHEAD)
            kept = StoredState(kept.parameters, stamp, signing.streams)
        if kept == self._kept:
            return True
        try:
            save_state(self._path, kept)
        except OSError as error:
            self._notify(states.notice(f"parameters not kept: {error.strerror or error}"))
            return False
        self._kept = kept
        return True
