"""MAVLink messages, frames, signatures and telemetry logs; without ports, clocks and global state."""

from __future__ import annotations

from magbridge.mavlink.codec import (
    Codec,
    FrameLogReader,
    FrameLogWriter,
    Signing,
    Stream,
    load_key,
    readable_by_all,
)
from magbridge.mavlink.messages import BAD_DATA, REFUSED, SECRET, Message, Source, Spec, by_id, spec
from magbridge.mavlink.tlog import LogReader, TlogRecord, pack_record, pack_records

__all__ = [
    "BAD_DATA", "REFUSED", "SECRET", "Codec", "FrameLogReader", "FrameLogWriter", "LogReader", "Message",
    "Signing", "Source", "Spec", "Stream", "TlogRecord", "by_id", "load_key", "pack_record", "pack_records",
    "readable_by_all", "spec",
]  # fmt: skip
