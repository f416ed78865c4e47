"""Write segment files of a Slocum glider, in the format that dbdreader reads."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

__all__ = ["CRC", "segment"]

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
    data += b"sa" + struct.pack("<hfd", 0x1234, 123.456, 123456789.12345)
    for row in zip(*cycles.values(), strict=True):
        bits = int.from_bytes(b"\xaa" * state, "big") & ~((1 << 2 * (4 * state - len(row))) - 1)
        data += b"d" + bits.to_bytes(state, "big") + struct.pack(f"<{len(row)}d", *row)
    path.write_bytes(data + b"X")
    if factored:
        path.with_name(f"{CRC}.cac").write_text(sensors)
