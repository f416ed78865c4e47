"""Messages of pymavlink's dialect ``all`` and of magbridge: layouts, received messages, frames.

pymavlink's classes define the layouts by which fields are read, `LAYOUTS` those that pymavlink lacks. This
module finds the frames in a stream of bytes, in place of pymavlink's ``parse_char``. After a wrong
checksum, ``parse_char`` skips as many bytes as the header states, so that garbage that looks like a header
hides valid frames (ArduPilot/pymavlink#387).
"""

from __future__ import annotations

import re
from functools import cache
from struct import Struct
from typing import Any, Final, TypeVar

import msgspec
from pymavlink.dialects.v20 import all as upstream

from magbridge.mavlink.enums import INVALID, LAYOUTS

__all__ = [
    "BAD_DATA", "EXTRA", "MAX_MESSAGE_ID", "MESSAGE_IDS", "NEEDS_MORE", "REFUSED", "SECRET",
    "SIGNATURE", "SIGNED", "V1", "V2", "Field", "Message", "Source", "Spec", "by_id", "checksum", "east_e7",
    "find_magic", "frame_end", "is_signed", "message", "spec", "split_index", "without_secret",
    "without_secrets",
]  # fmt: skip

BAD_DATA: Final = -1
"""Value of `Message.id` for bytes that belong to no frame."""
REFUSED: Final = -2
"""Value of `Message.id` for a frame whose signature is missing, wrong or old, or that contains a secret."""

T = TypeVar("T")
TURN_E7 = 3_600_000_000
"""Full circle, 1e-7 deg."""

MESSAGE_IDS: Final[dict[str, int]] = {
    **{layout.msgname: number for number, layout in upstream.mavlink_map.items()},
    **{name: number for number, (name, *_) in LAYOUTS.items()},
}
"""Message name -> id."""
EXTRA: Final = {
    **{number: bytes((layout.crc_extra,)) for number, layout in upstream.mavlink_map.items()},
    **{number: bytes((extra,)) for number, (_, extra, _) in LAYOUTS.items()},
}
"""Message id -> CRC_EXTRA, the last byte that the message's checksum covers."""


def definition(number: int) -> tuple[str, int, list[tuple[str, str, int, str]]]:
    """Return name, CRC_EXTRA and fields of a message, in the form of `LAYOUTS`."""
    if number in LAYOUTS:
        return LAYOUTS[number]
    its = upstream.mavlink_map[number]
    names, codes = its.ordered_fieldnames, its.native_format.decode()[1:].replace("c", "s")
    units = [its.fieldunits_by_name.get(name, "") for name in names]
    return its.msgname, its.crc_extra, list(zip(names, codes, its.array_lengths, units, strict=True))


class Field:
    """Definition of one field of a message: its place in the payload and its type.

    `name`, `unit`: name and unit in the dialect's XML.
    `count`: length of an array, 0 for a scalar.
    `code`: format character of :mod:`struct`; ``s`` is text, ``B`` with a count is bytes.
    `invalid`: value that means "not known"; in a float field, NaN always has this meaning.
    """

    __slots__ = ("code", "count", "invalid", "name", "offset", "struct", "unit")

    def __init__(self, name: str, code: str, count: int, unit: str, offset: int, invalid: int | None) -> None:
        self.name, self.code, self.count, self.unit = name, code, count, unit
        self.offset, self.invalid = offset, invalid
        packed_as_bytes = self.count and self.code in "sB"  # 253 integers a message would be slow
        self.struct = Struct(f"<{self.count}s" if packed_as_bytes else f"<{self.count or ''}{self.code}")

    def get(self, payload: bytes) -> Any:
        """Return the field's value in a full-length `payload`: int, float, str (text), bytes or a tuple."""
        values = self.struct.unpack_from(payload, self.offset)
        if self.code == "s":
            return values[0].partition(b"\0")[0].decode("ascii", "replace")  # as pymavlink
        return values if self.count and self.code != "B" else values[0]

    def put(self, value: Any) -> Any:
        """Return `value` in the form to pack with :attr:`Spec.struct`; a tuple for an array of numbers."""
        if self.code == "s":
            return value.encode()[: self.count or 1] if isinstance(value, str) else value
        return tuple(value) if self.count and self.code != "B" else value


class Spec:
    """Layout of one message.

    `id`: message id.
    `name`: message name.
    `extra`: CRC_EXTRA, the last byte that the checksum covers. It depends on the layout, so that a receiver
        with another layout rejects the frame.
    `size`: number of bytes of a full payload.
    `struct`: format of the full payload, with fields in the order of the wire and arrays of bytes as bytes.
    `fields`: field name -> definition, in the order of the wire.
    """

    def __init__(self, number: int) -> None:
        self.id = number
        self.name, self.extra, rows = definition(number)
        self.fields: dict[str, Field] = {}
        self.size, form = 0, "<"
        for row in rows:
            field = Field(*row, self.size, INVALID.get(self.name, {}).get(row[0]))
            self.fields[field.name] = field
            self.size += field.struct.size
            form += field.struct.format[1:]
        self.struct = Struct(form)
        zeros = bytes(self.size)
        self._defaults = {name: field.get(zeros) for name, field in self.fields.items()}
        # fields that are not a single number: texts and arrays
        self._uneven = [field for field in self.fields.values() if field.count or field.code == "s"]

    def payload(self, **fields: Any) -> bytes:
        """Return the packed payload with the values of `fields` by name; fields not given are zero.

        Raises
        ------
        KeyError
            The message has no such field.
        struct.error
            A value does not fit its field.
        """
        given = self._defaults | fields  # in the order of the wire
        if len(given) != len(self.fields):
            raise KeyError(f"{self.name} has no field {', '.join(sorted(given.keys() - self.fields.keys()))}")
        if not self._uneven:
            return self.struct.pack(*given.values())
        for field in self._uneven:
            given[field.name] = field.put(given[field.name])
        values: list[Any] = []
        for value in given.values():
            values += value if isinstance(value, tuple) else (value,)
        return self.struct.pack(*values)


@cache
def spec(message: int | str) -> Spec:
    """Return the layout of a message, by id or name; KeyError: the message does not exist."""
    return Spec(message) if isinstance(message, int) else spec(MESSAGE_IDS[message])


def by_id(**of: T) -> dict[int, T]:
    """Return the values of keyword arguments, named after messages, by message id; KeyError: unknown name."""
    return {spec(name).id: value for name, value in of.items()}


class Message(msgspec.Struct, frozen=True, gc=False):
    """Received message, whose fields are read by name: ``message["roll"]``."""

    id: int
    """Message id; `BAD_DATA` for bytes without a frame, `REFUSED` for a rejected frame."""
    system: int
    component: int
    sequence: int
    """`system`, `component`, `sequence`: System id, component id and sequence number of the sender."""
    payload: bytes
    """Payload, with the final zeros that MAVLink 2 does not transmit."""
    frame: bytes
    """All received bytes of the frame."""
    known: bool
    """True if the message is in the dialect and its checksum is correct."""

    @property
    def name(self) -> str:
        """Name of the message; ``UNKNOWN_<id>`` if the message is not in the dialect."""
        if self.known:
            return spec(self.id).name
        return {BAD_DATA: "BAD_DATA", REFUSED: "REFUSED"}.get(self.id, f"UNKNOWN_{self.id}")

    @property
    def fields(self) -> dict[str, Any]:
        """Values of all fields by name, in the order of the wire; empty if the message is not known."""
        return {name: self[name] for name in spec(self.id).fields} if self.known else {}

    def __getitem__(self, name: str) -> Any:
        layout = spec(self.id)
        field = layout.fields.get(name)
        if field is None:
            raise KeyError(f"{layout.name} has no field {name}")
        return field.get(self.payload)


def split_index(field: str) -> tuple[str, int | None]:
    """Split ``"actuator[2]"`` into name and index; the index of ``"actuator"`` is None."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
    if match is None:
        return field, None
    return match[1], int(match[2]) if match[2] else None


def east_e7(longitude: float) -> int:
    """Return a longitude (deg, any range) in 1e-7 deg, wrapped to -180 to 180 deg so that it fits 32 bits."""
    return (round(longitude * 1e7) + TURN_E7 // 2) % TURN_E7 - TURN_E7 // 2


V1: Final = upstream.PROTOCOL_MARKER_V1
V2: Final = upstream.PROTOCOL_MARKER_V2
SIGNED: Final = upstream.MAVLINK_IFLAG_SIGNED
SIGNATURE: Final = upstream.MAVLINK_SIGNATURE_BLOCK_LEN
"""Length of a signature, bytes: 1 of link id, 6 of time stamp, 6 of hash."""
NOT_A_FRAME: Final = 0
NEEDS_MORE: Final = -1
MAX_MESSAGE_ID: Final = 0xFFFF
"""Largest message id that is accepted of a message outside the dialect."""


def checksum(data: bytes, extra: bytes) -> int:
    """Return the checksum of `data`, a frame's bytes after the magic byte, followed by its CRC_EXTRA."""
    crc: int = upstream.x25crc(data + extra).crc
    return crc


def find_magic(data: bytes, start: int, stop: int) -> int:
    """Return the position in `data` of the first magic byte from `start` on; `stop` if none is before `stop`.

    A regular expression would take a hundred times as long for a long run of other bytes.
    """
    if start < stop and (data[start] == V2 or data[start] == V1):  # the usual case: right after a frame
        return start
    v2 = data.find(V2, start, stop)
    end = v2 if v2 >= 0 else stop
    v1 = data.find(V1, start, end)
    return v1 if v1 >= 0 else end


def frame_end(data: bytes, start: int, stop: int, *, last: bool = False) -> int:
    """Return the position in `data` where the frame that begins at ``data[start]`` ends.

    The checksum of a message outside the dialect cannot be checked. Such a frame is accepted if its header is
    plausible and another frame begins at its end, or the data end there. A random header is rarely plausible,
    so that garbage does not delay later frames.

    `data`: received bytes; ``data[start]`` is a magic byte.
    `start`, `stop`: only ``data[start:stop]`` is used.
    `last`: true if no bytes follow `stop`.
    Returns the end, or `NOT_A_FRAME`, or `NEEDS_MORE` if the decision needs the bytes from `stop` on.
    """
    available = stop - start
    header = 10 if data[start] == V2 else 6
    flags = data[start + 2] if header == 10 and available > 2 else 0
    # the standard demands that a frame with an unknown incompatibility flag is dropped
    if flags > SIGNED or available < header:
        return NOT_A_FRAME if flags > SIGNED else NEEDS_MORE
    number = data[start + 5] if header == 6 else _number(data, start)
    extra = EXTRA.get(number)
    if extra is None and (header == 6 or data[start + 3] or number > MAX_MESSAGE_ID):
        return NOT_A_FRAME
    body_end = start + header + data[start + 1]
    end = body_end + 2 + (SIGNATURE if flags else 0)
    if end > stop:
        return NEEDS_MORE
    if extra is not None:
        right = checksum(data[start + 1 : body_end], extra)
        return end if right == data[body_end] | data[body_end + 1] << 8 else NOT_A_FRAME
    if end >= stop:
        return end if last else NEEDS_MORE
    return end if data[end] in (V1, V2) else NOT_A_FRAME


def message(frame: bytes) -> Message:
    """Return the message in a frame that :func:`frame_end` has accepted."""
    header = 10 if frame[0] == V2 else 6
    number = frame[5] if header == 6 else _number(frame, 0)
    payload = frame[header : header + frame[1]]
    known = number in EXTRA
    if known:
        payload = payload.ljust(spec(number).size, b"\0")
    # the sequence, the sender's system and its component stand before the message's id
    sender = 4 if header == 10 else 2
    return Message(number, frame[sender + 1], frame[sender + 2], frame[sender], payload, frame, known)


def is_signed(frame: bytes) -> bool:
    """Return True if a frame carries a signature."""
    return frame[0] == V2 and bool(frame[2] & SIGNED)


def _number(data: bytes, start: int) -> int:
    """Return the id of the message whose version 2 frame begins at ``data[start]``."""
    return data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16


SECRET = frozenset(
    spec(name).id for name in ("SETUP_SIGNING", "AUTH_KEY", "CHANGE_OPERATOR_CONTROL", "WIFI_CONFIG_AP")
)
"""Ids of the messages that contain a key, a passkey or a password. The bridge rejects them and replaces their
payload by zeros, so that no log contains a secret."""
SECRET_HEADER = re.compile(
    rb"\xfd.{6}(?:" + b"|".join(re.escape(number.to_bytes(3, "little")) for number in SECRET) + rb")",
    re.DOTALL,
)


def without_secret(frame: bytes) -> bytes:
    """Return the frame of a message in `SECRET` with a payload of zeros and the matching checksum."""
    header = 10 if frame[0] == V2 else 6
    number = int.from_bytes(frame[7:10], "little") if header == 10 else frame[5]
    body = frame[1:header] + bytes(frame[1])
    end = header + frame[1]
    right = checksum(body, EXTRA[number])
    return frame[:1] + body + right.to_bytes(2, "little") + frame[end + 2 :]


def without_secrets(data: bytes) -> bytes:
    """Return bytes of incomplete frames, with zeros wherever the payload of a message in `SECRET` may be."""
    for match in SECRET_HEADER.finditer(data):
        begin = match.end()
        end = min(begin + data[match.start() + 1], len(data))
        data = data[:begin] + bytes(end - begin) + data[end:]
    return data


class Source:
    """Selection of one component as the source of a value, on a live link and in a bridge's log.

    The source is the component `wanted`, if given. Otherwise it is the first component that sends the value.
    The autopilot replaces any other source; another component replaces a source that has sent nothing for
    longer than `patience_us`.

    `autopilot`: component id of the autopilot.
    `patience_us`: time without a value after which another component may become the source, µs.
    `wanted`: component id of the only accepted source; None to select it as described.
    `component`: component id of the present source; None before the first value.
    """

    __slots__ = ("_autopilot", "_patience_us", "_received_us", "component", "wanted")

    def __init__(self, autopilot: int, patience_us: int, wanted: int | None = None) -> None:
        self._autopilot, self._patience_us, self.wanted = autopilot, patience_us, wanted
        self.component: int | None = None
        self._received_us = 0

    def admit(self, component: int, time_us: int) -> bool:
        """Update the source by a value from `component` at `time_us` (µs); return True if accepted."""
        if component != self.component:
            if self.wanted is not None:
                if component != self.wanted:
                    return False
            elif (
                self.component is not None
                and component != self._autopilot
                and time_us - self._received_us <= self._patience_us
            ):
                return False
            self.component = component
        self._received_us = time_us
        return True
