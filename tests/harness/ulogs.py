"""Write PX4 logs, after the specification of ULog."""

from __future__ import annotations

from struct import pack
from typing import Any

__all__ = ["Output", "ulog_of"]

Output = list[tuple[str, int, tuple[Any, ...]]]
"""Messages of a log: topic, instance and values of each."""


def ulog_of(topics: dict[str, tuple[str, str]], parameters: dict[str, float], texts: Output) -> bytes:
    """Return a ULog file of `topics` (name: field definition, struct format), parameters and messages."""

    def message(kind: str, body: bytes) -> bytes:
        return pack("<HB", len(body), ord(kind)) + body

    data = b"ULog\x01\x12\x35\x01" + pack("<Q", 0) + message("B", bytes(40))
    for name, (definition, _) in topics.items():
        data += message("F", f"{name}:{definition}".encode())
    for name, value in parameters.items():
        whole = isinstance(value, int)
        key = f"{'int32_t' if whole else 'float'} {name}".encode()
        data += message("P", bytes([len(key)]) + key + pack("<i" if whole else "<f", value))
    numbers: dict[tuple[str, int], int] = {}
    for name, instance, _ in texts:
        if (name, instance) not in numbers:
            numbers[name, instance] = len(numbers)
            data += message("A", pack("<BH", instance, numbers[name, instance]) + name.encode())
    for name, instance, values in texts:
        data += message("D", pack("<H", numbers[name, instance]) + pack(topics[name][1], *values))
    return data
