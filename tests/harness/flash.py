"""Write ArduPilot dataflash logs from the records that a test lists, as bytes or as text."""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Any

__all__ = ["KINDS", "Log", "described"]

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
