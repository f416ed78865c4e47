"""The messages of pymavlink's dialect ``all`` and of magbridge: their layouts, and a received message."""

from __future__ import annotations

import re
from functools import cache
from struct import Struct
from typing import Any, Final, TypeVar

from pymavlink.dialects.v20 import all as upstream

from magbridge.mavlink import dialect
from magbridge.mavlink.enums import INVALID

__all__ = [
    "BAD_DATA",
    "MESSAGES",
    "MESSAGE_IDS",
    "REFUSED",
    "Field",
    "Message",
    "Spec",
    "by_id",
    "east_e7",
    "spec",
    "split_index",
]  # fmt: skip

BAD_DATA: Final = -1
"""`Message.id` of bytes that belonged to no frame."""
REFUSED: Final = -2
"""`Message.id` of a frame whose signature is missing, wrong or old."""

T = TypeVar("T")
TURN_E7 = 3_600_000_000
"""A full circle in 1e-7 deg."""

MESSAGES: Final[dict[int, Any]] = {**upstream.mavlink_map, **dialect.mavlink_map}
"""Message id -> pymavlink's class of the message; ours and the few that the wheel lacks take precedence."""
dialect.mavlink_map.update(MESSAGES)  # the generated parser decodes all of them
MESSAGE_IDS = {layout.msgname: number for number, layout in MESSAGES.items()}
"""Message name -> id."""
DECODER: Final = dialect.MAVLink(None)
"""Decodes frames that were accepted; it holds no key and no buffer."""


class Field:
    """One field of a message: where it is in the payload, and how it reads.

    Attributes
    ----------
    name, unit : str
        As in the XML.
    count : int
        Length of an array, 0 for a scalar.
    code : str
        As in :mod:`struct`; ``s`` is text, ``B`` with a count is bytes.
    invalid : int or None
        The value that means "not known"; in a float field, NaN always does.
    """

    __slots__ = ("code", "count", "invalid", "name", "offset", "struct", "unit")

    def __init__(self, layout: Any, index: int, offset: int) -> None:
        self.name = layout.ordered_fieldnames[index]
        self.unit = layout.fieldunits_by_name.get(self.name, "")
        self.invalid = INVALID.get(layout.msgname, {}).get(self.name)
        self.count = layout.array_lengths[index]
        self.code = chr(layout.native_format[index + 1]).replace("c", "s")  # after the byte order
        self.offset = offset
        packed_as_bytes = self.count and self.code in "sB"  # 253 integers a message would be slow
        self.struct = Struct(f"<{self.count}s" if packed_as_bytes else f"<{self.count or ''}{self.code}")

    def get(self, payload: bytes) -> Any:
        """Return the value in a full-length `payload`: int, float, str (text), bytes or a tuple."""
        values = self.struct.unpack_from(payload, self.offset)
        if self.code == "s":
            return values[0].partition(b"\0")[0].decode("utf-8", "replace")
        return values if self.count and self.code != "B" else values[0]

    def put(self, value: Any) -> Any:
        """Return `value` as :attr:`Spec.struct` takes it: a tuple for an array of numbers, else one."""
        if self.code == "s":
            return value.encode()[: self.count or 1] if isinstance(value, str) else value
        return tuple(value) if self.count and self.code != "B" else value


class Spec:
    """The layout of one message, as pymavlink's class of it declares it.

    Attributes
    ----------
    id : int
    name : str
    extra : int
        CRC_EXTRA, the last byte that the checksum covers: it differs between different layouts, so that a
        receiver with another layout refuses the frame.
    size : int
        bytes of a full payload.
    struct : Struct
        Packs the full payload, fields in the order of the wire, arrays of bytes as bytes.
    fields : dict of str to Field
        In the order of the wire.
    """

    def __init__(self, number: int) -> None:
        layout = MESSAGES[number]
        self.id = number
        self.name: str = layout.msgname
        self.extra: int = layout.crc_extra
        self.size: int = layout.unpacker.size
        self.fields: dict[str, Field] = {}
        offset, form = 0, "<"
        for index in range(len(layout.ordered_fieldnames)):
            field = Field(layout, index, offset)
            self.fields[field.name] = field
            offset += field.struct.size
            form += field.struct.format[1:]
        self.struct = Struct(form)
        zeros = bytes(self.size)
        self._defaults = {name: field.get(zeros) for name, field in self.fields.items()}
        # not one number: texts and arrays
        self._uneven = [field for field in self.fields.values() if field.count or field.code == "s"]

    def payload(self, **fields: Any) -> bytes:
        """Pack `fields` by name; those not named are zero.

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
    """Return the layout of a message, by id or name; KeyError: no such message."""
    return Spec(message) if isinstance(message, int) else spec(MESSAGE_IDS[message])


def by_id(**of: T) -> dict[int, T]:
    """Return values that are named after messages, by the messages' ids; KeyError: no such message."""
    return {spec(name).id: value for name, value in of.items()}


class Message:
    """A received message. pymavlink decodes it when a field is first read: ``message["roll"]``.

    Attributes
    ----------
    id : int
        Message id; `BAD_DATA` and `REFUSED` for bytes and frames that are not to be read.
    system, component, sequence : int
        The sender's.
    payload : bytes
        Zeros that the sender cut off are put back.
    frame : bytes
        The whole frame as it came.
    known : bool
        The message is in the dialect, and its checksum was right.
    """

    __slots__ = ("_decoded", "component", "frame", "id", "known", "payload", "sequence", "system")

    def __init__(
        self,
        number: int,
        system: int,
        component: int,
        sequence: int,
        payload: bytes,
        frame: bytes,
        known: bool,
    ) -> None:
        self.id, self.system, self.component, self.sequence = number, system, component, sequence
        self.payload, self.frame, self.known = payload, frame, known
        self._decoded: Any = None

    @property
    def name(self) -> str:
        """The message's name; ``UNKNOWN_<id>`` where the dialect lacks it."""
        if self.known:
            return spec(self.id).name
        return {BAD_DATA: "BAD_DATA", REFUSED: "REFUSED"}.get(self.id, f"UNKNOWN_{self.id}")

    @property
    def fields(self) -> dict[str, Any]:
        """All fields by name, in the order of the wire; empty where the message is not known."""
        return {name: self[name] for name in spec(self.id).fields} if self.known else {}

    def __getitem__(self, name: str) -> Any:
        if self._decoded is None:
            self._decoded = DECODER.decode(bytearray(self.frame))
        value = getattr(self._decoded, name) if name in MESSAGES[self.id].fieldnames else None
        if value is None:
            raise KeyError(f"{spec(self.id).name} has no field {name}")
        if isinstance(value, list):
            return bytes(value) if spec(self.id).fields[name].code == "B" else tuple(value)
        return value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Message) and (self.id, self.frame) == (other.id, other.frame)

    def __hash__(self) -> int:
        return hash((self.id, self.frame))

    def __repr__(self) -> str:
        return f"<Message {self.name} of {self.system}:{self.component}>"


def split_index(field: str) -> tuple[str, int | None]:
    """Split ``"actuator[2]"`` into name and index; the index is None where there is none."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
    if match is None:
        return field, None
    return match[1], int(match[2]) if match[2] else None


def east_e7(longitude: float) -> int:
    """Return a longitude (deg, of any turn) in 1e-7 deg, -180 to 180: beyond 214, 32 bits overflow."""
    return (round(longitude * 1e7) + TURN_E7 // 2) % TURN_E7 - TURN_E7 // 2
