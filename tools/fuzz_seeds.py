"""Whole inputs for tools/fuzz.py to damage: what our own writers and emulators write, or as a format says."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magbridge.field.grid import AnomalyGrid
from magbridge.records import Reading

__all__ = ["SEEDS"]

LON, LAT = np.linspace(10.0, 10.5, 11), np.linspace(54.0, 54.4, 9)
MAP = 30.0 * np.sin(9.0 * np.meshgrid(LON, LAT)[0]) + 100.0 * (np.meshgrid(LON, LAT)[1] - 54.0)


CONFIG = """
[sensor]
driver = "ascii"
port = "loop://"
[sensor.options]
columns = ["x", "y", "z"]
[link]
url = "udpout:192.0.2.1:14550"
system = 1
[telemetry.battpos]
message = "NAMED_VALUE_FLOAT"
match = {name = "battpos"}
field = "value"
[publish]
MAG_FIELD = 0
[log]
directory = "logs"
"""


def _log() -> xr.Dataset:
    t = 1.7e9 + 4.0 * np.arange(60)
    columns = {
        name: ("time", 2e4 + 100.0 * np.sin(t / 50.0 + k))
        for k, name in enumerate(("mag_x", "mag_y", "mag_z"))
    }
    more = {
        "roll": 5.0 * np.sin(t / 30.0),
        "latitude": 54.0 + (t - t[0]) * 1e-6,
        "longitude": 10.0 + 0.0 * t,
        "battpos": np.where(t % 40 < 20, 0.1, 0.4),
    }
    return xr.Dataset(
        {**columns, **{k: ("time", v) for k, v in more.items()}}, {"time": t}, {"source": "fuzz"}
    )


def _written(suffix: str, folder: Path) -> list[bytes]:
    from magbridge.logs import write

    path = folder / f"seed{suffix}"
    write(_log(), path)
    return [path.read_bytes()]


def _encoded(name: str, options: dict[str, Any], _: Path) -> list[bytes]:
    from magbridge.sensors import open_driver
    from sitl.fluxgate import open_encoder

    encoder, driver = open_encoder(name, options, rate=10.0), open_driver(name, options)
    answers = b"".join(encoder.feed(command) for command in driver.start())
    readings = [Reading((2e4 + k, -3e3 * k, 4.5e4), device_time=0.1 * k) for k in range(5)]
    return [answers + b"".join(encoder.encode(reading) for reading in readings), b"", b"\0" * 64]


def _frames(_: Path) -> list[bytes]:
    from magbridge.mavlink.codec import Codec

    codec = Codec(1, 1)
    frames = [
        codec.pack("HEARTBEAT", type=12),
        codec.pack("ATTITUDE", time_boot_ms=1000, roll=0.1, yaw=2.0),
        codec.pack("NAMED_VALUE_FLOAT", name="battpos", value=0.3),
        codec.pack("PARAM_SET", param_id="MB_OFFSET", param_value=1.0),
        codec.pack("MAG_FIELD", time_usec=5, total_field=50_000.0),
    ]
    return [b"".join(frames), *frames]


def _frame_log(folder: Path) -> list[bytes]:
    return [
        b"".join(struct.pack(">Q", 1_700_000_000_000_000 + k) + f for k, f in enumerate(_frames(folder)[1:]))
    ]


def _calibration(_: Path) -> list[bytes]:
    from magbridge.calibration.file import encode_calibration
    from magbridge.calibration.model import Calibration, Noise, Parameter, Reference, Run, Sensor
    from magbridge.calibration.terms import Polynomial, full_order

    rng = np.random.default_rng(1)
    root = rng.normal(size=(27, 27))
    made = Calibration(
        parameters=(Parameter("battpos", "in", -0.4, 0.5, 0.05, 0.45),),
        terms=(Polynomial(exponents=full_order(1, 2)),),
        effects=(),
        coefficients=rng.normal(size=27) * 100.0,
        covariance=root @ root.T,
        noise=Noise(1.0, 0.0, 0.3, 4.0),
        reference=Reference(51_000.0, "IGRF"),
        sensor=Sensor("digitizer", 3),
        boresight=None,
        runs=(Run("1", 225, 1.1, (0.3,)),),
        method="auto",
        inputs={"a.csv": "00"},
        software="magbridge 0.1.0",
    )
    return [encode_calibration(made)]


def _config(_: Path) -> list[bytes]:
    return [CONFIG.encode()]


def _ardupilot(_: Path) -> list[bytes]:
    def fmt(number: int, size: int, name: str, letters: str, fields: str) -> bytes:
        text = struct.pack("<BB4s16s64s", number, size, name.encode(), letters.encode(), fields.encode())
        return b"\xa3\x95\x80" + text

    names = "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"
    data = fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns") + fmt(
        100, 35, "MAG", "QBhhhhhhhhhBI", names
    )
    for k in range(20):
        values = 100_000 * k, 0, 100 + k, 20, -300, 7, 0, 0, 0, 0, 0, 1, 0
        data += b"\xa3\x95\x64" + struct.pack("<QB9hBI", *values)
    return [data]


def _px4(_: Path) -> list[bytes]:
    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    data += message("F", b"sensor_mag:uint64_t timestamp;float x;float y;float z;")
    data += message("A", struct.pack("<BH", 0, 0) + b"sensor_mag")
    for k in range(20):
        data += message("D", struct.pack("<HQ3f", 0, 1000 * k, 0.2, 0.01 * k, -0.4))
    return [data]


def _slocum(_: Path) -> list[bytes]:
    tags = {
        "dbd_label": "DBD(dinkum_binary_data)file", "encoding_ver": 5, "num_ascii_tags": 14,
        "all_sensors": "T", "the8x3_filename": "00010000", "full_filename": "made-2024-001-0-0",
        "filename_extension": "dbd", "mission_name": "MADE.MI", "fileopen_time": "Mon_Jan__1_00:00:00_2024",
        "total_num_sensors": 3, "sensors_per_cycle": 3, "state_bytes_per_cycle": 1,
        "sensor_list_crc": "0badcafe", "sensor_list_factored": 0,
    }  # fmt: skip
    header = "".join(f"{name}:    {value}\n" for name, value in tags.items())
    sensors = (("m_present_time", 8, "timestamp"), ("m_roll", 4, "rad"), ("m_battpos", 4, "in"))
    header += "".join(
        f"s: T {k:4} {k:4} {size} {name} {unit}\n" for k, (name, size, unit) in enumerate(sensors)
    )
    data = header.encode() + b"sa" + struct.pack("<hfd", 0x1234, 123.456, 123456789.12345)
    for k in range(20):
        data += b"d" + bytes([0b10101000]) + struct.pack("<dff", 1.7e9 + 4.0 * k, 0.1 * k, 0.3)
    return [data + b"X"]


def _grid(_: Path, form: str) -> list[bytes]:
    text = "\n".join(" ".join(f"{v:.6g}" for v in row) for row in MAP)
    flipped = "\n".join(" ".join(f"{v:.6g}" for v in row) for row in MAP[::-1])
    if form == "esri":
        header = (
            f"ncols {LON.size}\nnrows {LAT.size}\nxllcenter {LON[0]}\nyllcenter {LAT[0]}\ncellsize 0.05\n"
        )
        return [(header + "NODATA_value -9999\n" + flipped).encode()]
    if form == "table":
        x, y = np.meshgrid(LON, LAT)
        rows = zip(x.ravel(), y.ravel(), MAP.ravel(), strict=True)
        lines = "".join(f"{a:.3f},{b:.3f},{c:.2f}\n" for a, b, c in rows)
        return [("longitude,latitude,mag [nT]\n" + lines).encode(), ("x,y,z,mag\n" + lines).encode()]
    limits = LON[0], LON[-1], LAT[0], LAT[-1], MAP.min(), MAP.max()
    six = struct.pack("<4s2h6d", b"DSBB", *MAP.shape[::-1], *limits) + MAP.astype("<f4").tobytes()
    numbers = LON[0], LAT[0], 0.05, 0.05, MAP.min(), MAP.max(), 0.0, 1.70141e38
    sections: tuple[tuple[bytes, bytes], ...] = (
        (b"DSRB", struct.pack("<i", 2)),
        (b"GRID", struct.pack("<2i8d", *MAP.shape, *numbers)),
    )
    sections += ((b"DATA", MAP.astype("<f8").tobytes()),)
    seven = b"".join(tag + struct.pack("<i", len(body)) + body for tag, body in sections)
    plain = f"DSAA\n{LON.size} {LAT.size}\n{LON[0]} {LON[-1]}\n{LAT[0]} {LAT[-1]}\n-30 30\n{text}"
    return [six, seven, plain.encode()]


def _geosoft(_: Path) -> list[bytes]:
    """Geosoft GRD version 2: 512 bytes of header, then 4-byte floats; and compressed in one block."""
    import zlib

    ny, nx = MAP.shape
    found = []
    for size in (4, 1024 + 4):
        header = bytearray(512)
        struct.pack_into("<5i", header, 0, size, 2, nx, ny, 1)
        struct.pack_into("<5d", header, 20, 0.05, 0.05, LON[0], LAT[0], 0.0)
        struct.pack_into("<2d", header, 60, 0.0, 1.0)
        values = MAP.astype("<f4").tobytes()
        if size > 1024:
            block = bytes(16) + zlib.compress(values)
            index = struct.pack("<qi", 512 + 16 + 12, len(block))
            values = struct.pack("<4i", 0, 0, 1, ny) + index + block
        found.append(bytes(header) + values)
    return found


def _geotiff(folder: Path) -> list[bytes]:
    from PIL import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    tags = ImageFileDirectory_v2()
    for tag, kind, value in (
        (33550, 12, (0.05, 0.05, 0.0)),
        (33922, 12, (0.0, 0.0, 0.0, LON[0] - 0.025, LAT[-1] + 0.025, 0.0)),
        (34735, 3, (1, 1, 0, 2, 1024, 0, 1, 2, 1025, 0, 1, 1)),
        (42113, 2, "-9999"),
    ):
        tags[tag], tags.tagtype[tag] = value, kind
    Image.fromarray(MAP[::-1].astype(np.float32)).save(folder / "seed.tif", tiffinfo=tags)
    return [(folder / "seed.tif").read_bytes()]


def _map(folder: Path) -> list[bytes]:
    AnomalyGrid(LON, LAT, MAP, 1.0, 300.0).save(folder / "seed.nc")
    return [(folder / "seed.nc").read_bytes()]


SEEDS: dict[str, Callable[[Path], list[bytes]]] = {
    "digitizer": partial(_encoded, "digitizer", {"sensitivity": 5e-5}),
    "hmr2300": partial(_encoded, "hmr2300", {"output": "ascii"}),
    "hmr2300-binary": partial(_encoded, "hmr2300", {"output": "binary"}),
    "twinleaf": partial(_encoded, "twinleaf", {"temperature": "therm"}),
    "ascii": partial(_encoded, "ascii", {"columns": ["x", "y", "z", "temperature"], "unit": "G"}),
    "nmea": partial(
        _encoded,
        "ascii",
        {"prefix": "$PMAG,", "separator": ",", "columns": ["time", "x", "y", "z"], "checksum": "nmea"},
    ),
    "mavlink": _frames,
    "frame_log": _frame_log,
    "calibration": _calibration,
    "config": _config,
    "polygon": lambda _: [b"longitude,latitude\n10.1,54.1\n10.4,54.1\n10.2,54.3\n"],
    "csv": partial(_written, ".csv"),
    "tlog": partial(_written, ".tlog"),
    "netcdf": partial(_written, ".nc"),
    "parquet": partial(_written, ".parquet"),
    "ardupilot": _ardupilot,
    "px4": _px4,
    "slocum": _slocum,
    "table": partial(_grid, form="table"),
    "esri": partial(_grid, form="esri"),
    "surfer": partial(_grid, form="surfer"),
    "geosoft": _geosoft,
    "geotiff": _geotiff,
    "grid-netcdf": _map,
}
"""Target to what makes its seeds, given a folder to write to."""
