"""The layout of messages on the wire, and a received message."""

from __future__ import annotations

import re
from functools import cache
from struct import Struct
from typing import Any, Final, TypeVar

import msgspec

from magbridge.mavlink.dialect import MESSAGES

__all__ = ["BAD_DATA", "REFUSED", "Field", "Message", "Spec", "by_id", "east_e7", "spec", "split_index"]

BAD_DATA: Final = -1
"""`Message.id` of bytes that belonged to no frame."""
REFUSED: Final = -2
"""`Message.id` of a frame whose signature is missing, wrong or old."""

T = TypeVar("T")
TURN_E7 = 3_600_000_000
"""A full circle in 1e-7 deg."""
IDS = {name: number for number, (name, _, _) in MESSAGES.items()}


class Field:
    """One field of a message: where it lies in the payload, and how it reads.

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

    def __init__(self, text: str, offset: int) -> None:
        form, self.name, self.unit, invalid = text.split(":")
        self.invalid = int(invalid) if invalid else None
        self.count, self.code = int(form[:-1] or 0), form[-1]
        self.offset = offset
        packed_as_bytes = self.code == "B" and self.count  # 253 integers a message would be slow
        self.struct = Struct(f"<{self.count}s" if packed_as_bytes else f"<{form}")

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
    """The layout of one message.

    Attributes
    ----------
    id : int
    name : str
    number : bytes
        The id as it stands on the wire.
    extra : int
        CRC_EXTRA, the last byte that the checksum covers: it differs between different layouts, so that a
        receiver with another layout refuses the frame.
    size : int
        bytes of a full payload.
    struct : Struct
        Packs the full payload, fields in the order of the wire.
    fields : dict of str to Field
        In the order of the wire.
    """

    def __init__(self, number: int) -> None:
        self.id = number
        self.name, self.extra, text = MESSAGES[number]
        self.number = number.to_bytes(3, "little")
        self.fields: dict[str, Field] = {}
        offset, form = 0, "<"
        for part in text.split(","):
            field = Field(part, offset)
            self.fields[field.name] = field
            offset += field.struct.size
            form += field.struct.format[1:]
        self.size = offset
        self.struct = Struct(form)
        zeros = bytes(offset)
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
    return Spec(message) if isinstance(message, int) else spec(IDS[message])


def by_id(**of: T) -> dict[int, T]:
    """Return what is named after messages, as what handles them, by their ids; KeyError: there is no such."""
    return {spec(name).id: one for name, one in of.items()}


class Message(msgspec.Struct, frozen=True, gc=False):
    """A received message. Its fields are read when asked for: ``message["roll"]``."""

    id: int
    """Message id; `BAD_DATA` and `REFUSED` for what is not to be read."""
    system: int
    component: int
    sequence: int
    """`system`, `component`, `sequence`: The sender's."""
    payload: bytes
    """Zeros that the sender cut off are put back."""
    frame: bytes
    """The whole frame as it came."""
    known: bool
    """The message is in the dialect, and its checksum was right."""

    @property
    def name(self) -> str:
        """The message's name; ``UNKNOWN_<id>`` where the dialect lacks it."""
        if self.known:
            return spec(self.id).name
        return {BAD_DATA: "BAD_DATA", REFUSED: "REFUSED"}.get(self.id, f"UNKNOWN_{self.id}")

    @property
    def fields(self) -> dict[str, Any]:
        """All fields by name, in the order of the wire; empty where the message is not known."""
        if not self.known:
            return {}
        return {name: field.get(self.payload) for name, field in spec(self.id).fields.items()}

    def __getitem__(self, name: str) -> Any:
        return spec(self.id).fields[name].get(self.payload)


def split_index(field: str) -> tuple[str, int | None]:
    """Split ``"actuator[2]"`` into name and index; the index is None where there is none."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
    if match is None:
        return field, None
    return match[1], int(match[2]) if match[2] else None


def east_e7(longitude: float) -> int:
    """Return a longitude (deg, of any turn) in 1e-7 deg, -180 to 180: beyond 214, 32 bits overflow."""
    return (round(longitude * 1e7) + TURN_E7 // 2) % TURN_E7 - TURN_E7 // 2
