"""Write one anomaly map in each third-party format that magbridge reads."""

import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

LON, LAT = np.linspace(10.0, 10.5, 11), np.linspace(54.0, 54.4, 9)
GEOTIFF_TAGS = (33550, 12), (33922, 12), (34735, 3), (42113, 2)
"""GeoTIFF tags of pixel scale, tie point, keys and no-data value, each with its TIFF type."""
MAP = 30 * np.sin(np.meshgrid(LON, LAT)[0] * 9) + 100 * (np.meshgrid(LON, LAT)[1] - 54)


def lines(values: np.ndarray, delimiter: str = " ") -> str:
    """Return the rows of a grid as text."""
    return "\n".join(delimiter.join(f"{v:.9g}" for v in row) for row in values)


def surfer_text(path: Path) -> None:
    """Write the map as a Surfer grid in ASCII."""
    first_lines = (
        f"DSAA\n{LON.size} {LAT.size}\n{LON[0]} {LON[-1]}\n{LAT[0]} {LAT[-1]}\n{MAP.min()} {MAP.max()}\n"
    )
    path.write_text(first_lines + lines(MAP))


def surfer_6(path: Path) -> None:
    """Write the map as a binary grid of Surfer 6."""
    limits = LON[0], LON[-1], LAT[0], LAT[-1], MAP.min(), MAP.max()
    path.write_bytes(struct.pack("<4s2h6d", b"DSBB", *MAP.shape[::-1], *limits) + MAP.astype("<f4").tobytes())


def surfer_7(path: Path, rotation: float = 0.0, blank: float = 1.70141e38) -> None:
    """Write the map as a binary grid of Surfer 7."""
    numbers = LON[0], LAT[0], LON[1] - LON[0], LAT[1] - LAT[0], MAP.min(), MAP.max(), rotation, blank
    grid, data = struct.pack("<2i8d", *MAP.shape, *numbers), MAP.astype("<f8").tobytes()
    sections = (b"DSRB", struct.pack("<i", 2)), (b"GRID", grid), (b"DATA", data)
    path.write_bytes(b"".join(tag + struct.pack("<i", len(body)) + body for tag, body in sections))


def esri(path: Path) -> None:
    """Write the map as an ESRI ASCII grid whose header states the centre of the lower-left cell."""
    first_lines = (
        f"ncols {LON.size}\nnrows {LAT.size}\nxllcenter {LON[0]}\nyllcenter {LAT[0]}\ncellsize 0.05\n"
    )
    path.write_text(first_lines + "NODATA_value -9999\n" + lines(MAP[::-1]))


def esri_corner(path: Path) -> None:
    """Write the map as an ESRI ASCII grid whose header states the corner of the lower-left cell."""
    corner = f"XLLCORNER {LON[0] - 0.025}\nYLLCORNER {LAT[0] - 0.025}"
    path.write_text(f"NCOLS {LON.size}\nNROWS {LAT.size}\n{corner}\nCELLSIZE 0.05\n{lines(MAP[::-1])}")


def table(
    path: Path,
    header: str = "longitude,latitude,anomaly\n",
    delimiter: str = ",",
    scale: float = 1.0,
    *,
    height: bool = False,
) -> None:
    """Write the map as text columns below a `header` line, with the rows in random order."""
    x, y = np.meshgrid(LON, LAT)
    heights = [np.linspace(100.0, 140.0, MAP.size)] if height else []
    rows = np.column_stack([x.ravel(), y.ravel(), *heights, MAP.ravel() * scale])
    np.random.default_rng(0).shuffle(rows)
    path.write_text(header + lines(rows, delimiter))


def geotiff(path: Path, **others: object) -> None:
    """Write the map as a GeoTIFF; `others` replaces values of tags by name."""
    tags = ImageFileDirectory_v2()
    wanted = {
        "scale": (0.05, 0.05, 0.0),
        "tie_point": (0.0, 0.0, 0.0, LON[0] - 0.025, LAT[-1] + 0.025, 0.0),
        "keys": (1, 1, 0, 2, 1024, 0, 1, 2, 1025, 0, 1, 1),
        "hole": "-9999",
    } | others
    for (tag, kind), value in zip(GEOTIFF_TAGS, wanted.values(), strict=True):
        tags[tag], tags.tagtype[tag] = value, kind
    Image.fromarray(MAP[::-1].astype(np.float32)).save(path, tiffinfo=tags)


def geosoft(path: Path, *, compressed: bool = False) -> None:
    """Write the map as a Geosoft GRD of version 2: 512 bytes of header, then 4-byte floats."""
    ny, nx = MAP.shape
    header = bytearray(512)
    struct.pack_into("<5i", header, 0, 4 + 1024 * compressed, 2, nx, ny, 1)
    struct.pack_into("<5d", header, 20, 0.05, 0.05, LON[0], LAT[0], 0.0)
    struct.pack_into("<2d", header, 60, 0.0, 1.0)
    values = MAP.astype("<f4").tobytes()
    if compressed:
        block = bytes(16) + zlib.compress(values)
        values = struct.pack("<4iqi", 0, 0, 1, ny, 512 + 16 + 12, len(block)) + block
    path.write_bytes(bytes(header) + values)
