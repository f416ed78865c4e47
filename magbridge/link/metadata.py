"""MAVLink metadata of the parameters: text, unit, range and default for ground stations.

A station asks for COMPONENT_METADATA, reads the general file that it names by MAVLink FTP, and from there the
file of the parameters (MAVLink guide, 'Component Metadata Protocol').
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from math import ceil, log10

import msgspec

from magbridge.link.parameters import Tunable

__all__ = ["GENERAL", "crc32", "files", "uri"]

GENERAL, PARAMETERS = "/general.json", "/parameter.json"
PARAMETER_TYPE = 1
"""COMP_METADATA_TYPE_PARAMETER"""
GROUPS = {"publish": "Rates", "align": "Alignment", "telemetry": "Telemetry", "files": "Files"}
"""By the first part of a parameter's key."""
MOST_PLACES = 7


def crc32(data: bytes, initial: int = 0) -> int:
    """Return the CRC-32 of MAVLink FTP: that of zlib without the inversions at begin and end."""
    return zlib.crc32(data, initial ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def uri(component: int, path: str) -> str:
    """Return the URI of a file of `component`."""
    return f"mftp://[;comp={component}]{path}"


def files(parameters: Iterable[Tunable], component: int) -> Mapping[str, bytes]:
    """Return the general file and that of the parameters, by path."""
    rows = msgspec.json.encode({"version": 1, "parameters": [describe(row) for row in parameters]})
    kinds = [{"type": PARAMETER_TYPE, "uri": uri(component, PARAMETERS), "fileCrc": crc32(rows)}]
    general = msgspec.json.encode({"version": 1, "metadataTypes": kinds})
    return {GENERAL: general, PARAMETERS: rows}


def describe(row: Tunable) -> dict[str, object]:
    """Return the metadata of one parameter by the schema of MAVLink."""
    smallest = min((abs(value) for value in (row.default, row.low) if value), default=1.0)
    return {
        "name": row.name,
        "type": "Float",
        "shortDesc": row.doc[:1].upper() + row.doc[1:],
        "longDesc": f"{row.key} of the configuration. Takes effect at once, and is kept over restarts.",
        "units": row.unit,
        "default": row.default,
        "min": row.low,
        "max": row.high,
        "decimalPlaces": min(max(ceil(-log10(smallest)) + 1, 2), MOST_PLACES),
        "rebootRequired": False,
        "volatile": False,
        "group": GROUPS.get(row.key.partition(".")[0], "Standard"),
        "category": "Standard",
    }
