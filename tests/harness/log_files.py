"""Write logs in the formats of ArduPilot (bytes or text), of a Slocum (segments) and of PX4 (ULog)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from struct import Struct, pack
from typing import Any

import numpy as np

FORMS = {"c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "n": "4s", "N": "16s", "Z": "64s", "M": "B"}
SCALES = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 1e7}
KINDS = {
    # name: (number, letters, fields)
    "PARM": (10, "QNf", "TimeUS,Name,Value"),
    "GPS": (11, "QBIHBcLL", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng"),
    "ATT": (12, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "BAT": (13, "QBff", "TimeUS,Instance,Volt,Curr"),
    "MAG": (14, "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "IMU": (15, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "BARO": (16, "QBff", "TimeUS,I,Alt,Press"),
    "XKFS": (17, "QBBBBB", "TimeUS,C,MI,BI,GI,AI"),
    "UNIT": (18, "QbZ", "TimeUS,Id,Label"),
    "MULT": (19, "Qbd", "TimeUS,Id,Mult"),
    "FMTU": (20, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
}


def described(number: int, length: int, name: str, letters: str, fields: str) -> bytes:
    """Return the ``FMT`` record that describes the records of one kind."""
    body = Struct("<BB4s16s64s").pack(number, length, name.encode(), letters.encode(), fields.encode())
    return b"\xa3\x95\x80" + body


class Log:
    """A log that grows by records, as bytes (`data`) and as lines of text (`lines`)."""

    def __init__(self, kinds: dict[str, tuple[int, str, str]] = KINDS) -> None:
        self.kinds = kinds
        self.structs = {
            name: Struct("<" + "".join(FORMS.get(letter, letter) for letter in letters))
            for name, (_, letters, _) in kinds.items()
        }
        self.data = described(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
        self.lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
        for name, (number, letters, fields) in kinds.items():
            length = self.structs[name].size + 3
            self.data += described(number, length, name, letters, fields)
            self.lines.append(f"FMT, {number}, {length}, {name}, {letters}, {fields}")

    def record(self, name: str, *values: Any) -> bytes:
        """Return the bytes of a record; `values` are in the units of its fields."""
        number, letters, _ = self.kinds[name]
        raw: Sequence[Any] = [
            round(value * SCALES[one]) if one in SCALES else value.encode() if one in "nNZ" else value
            for value, one in zip(values, letters, strict=True)
        ]
        return b"\xa3\x95" + bytes([number]) + self.structs[name].pack(*raw)

    def write_message(self, name: str, *values: Any) -> None:
        """Append a record of the kind `name` to `data` and to `lines`."""
        self.data += self.record(name, *values)
        self.lines.append(", ".join([name, *map(str, values)]))

    def fix(self, us: int, utc: float, status: int = 3) -> None:
        """Append a GPS fix at `us` (µs since boot); `utc` is s since 1970."""
        gps = utc + 18 - 315_964_800
        self.write_message(
            "GPS", us, status, round(gps % 604_800 * 1000), int(gps // 604_800), 9, 1.0, 45.0, -63.0
        )

    def mag(
        self, us: int, number: int, field: Sequence[int], health: int = 1, offsets: Sequence[int] = ()
    ) -> None:
        """Append a sample (mG) of a compass; `offsets` are three sensor offsets, then three motor offsets."""
        self.write_message("MAG", us, number, *field, *(offsets or (0,) * 6), health, us & 0xFFFFFFFF)


CRC = "ab12cd34"


def segment(path: Path, cycles: Mapping[str, np.ndarray], *, factored: bool = False) -> None:
    """Write a file in which every sensor of `cycles` is updated in every cycle.

    A cycle consists of ``d``, two bits per sensor (2: updated) and the values of eight bytes each. With
    `factored`, the list of sensors is in a separate ``.cac`` file.
    """
    names = list(cycles)
    sensors = "".join(f"s: T {k} {k} 8 {name} unit\n" for k, name in enumerate(names))
    state = (len(names) + 3) // 4
    tags = {
        "dbd_label": "DBD(dinkum_binary_data)file", "encoding_ver": 5, "num_ascii_tags": 14, "all_sensors": 0,
        "the8x3_filename": "00010000", "full_filename": path.stem, "filename_extension": path.suffix[1:],
        "mission_name": "MADE.MI", "fileopen_time": "Mon_Jan__1_00:00:00_2024",
        "total_num_sensors": len(names), "sensors_per_cycle": len(names), "state_bytes_per_cycle": state,
        "sensor_list_crc": CRC.upper(),
        "sensor_list_factored": int(factored),
    }  # fmt: skip
    data = "".join(f"{name}:    {value}\n" for name, value in tags.items()).encode()
    data += b"" if factored else sensors.encode()
    data += b"sa" + pack("<hfd", 0x1234, 123.456, 123456789.12345)
    for row in zip(*cycles.values(), strict=True):
        bits = int.from_bytes(b"\xaa" * state, "big") & ~((1 << 2 * (4 * state - len(row))) - 1)
        data += b"d" + bits.to_bytes(state, "big") + pack(f"<{len(row)}d", *row)
    path.write_bytes(data + b"X")
    if factored:
        path.with_name(f"{CRC}.cac").write_text(sensors)


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
