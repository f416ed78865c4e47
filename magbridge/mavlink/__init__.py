"""MAVLink: messages as a table, frames, signatures, logs. No port, no clock, no global state."""

from __future__ import annotations

from magbridge.mavlink.codec import Codec
from magbridge.mavlink.messages import BAD_DATA, REFUSED, Message, Spec, spec
from magbridge.mavlink.signing import Signing, load_key
from magbridge.mavlink.tape import TapeReader, TapeWriter
from magbridge.mavlink.tlog import LogReader, Record, pack_record, pack_records

__all__ = [
    "BAD_DATA",
    "REFUSED",
    "Codec",
    "LogReader",
    "Message",
    "Record",
    "Signing",
    "Spec",
    "TapeReader",
    "TapeWriter",
    "load_key",
    "pack_record",
    "pack_records",
    "spec",
]
