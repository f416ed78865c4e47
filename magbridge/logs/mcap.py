"""Read and write MCAP with JSON messages and a schema for each topic, as Foxglove and Lichtblick open it.

A row becomes one message in each topic for which it has a known value: ``/magnetometer`` (raw), ``/field``
(corrected), ``/quality`` (flags, also as booleans), ``/vehicle`` (attitude, position, speed) and
``/telemetry`` (all other columns). ``/position`` repeats the position as a ``foxglove.LocationFix``. The
module reads only files that it has written; :mod:`.rosbag` reads the MCAP files of robots.

References
----------
MCAP Format Specification, https://mcap.dev/spec
Foxglove, "foxglove.LocationFix", https://docs.foxglove.dev/docs/sdk/schemas/location-fix
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import xarray as xr

from magbridge.arrays import FloatArray
from magbridge.columns import COLUMNS
from magbridge.errors import FormatError, MissingExtra, WriteError
from magbridge.logs.deployment import deployment, plain_attrs, sliced
from magbridge.records import Quality

try:
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap.writer import Writer
except ImportError:
    raise MissingExtra("mcap", "formats") from None

PROFILE = "magbridge"
"""Profile in the header of each file that this module writes."""
RAW, FIELD, FLAGS, VEHICLE, OTHER_TOPIC = "/magnetometer", "/field", "/quality", "/vehicle", "/telemetry"
POSITION_TOPIC = "/position"
WHEN = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
NUMBER_SCHEMA = {"type": "number"}
LOCATION = {
    "timestamp": WHEN,
    "frame_id": {"type": "string"},
    "latitude": {**NUMBER_SCHEMA, "description": "deg, north positive"},
    "longitude": {**NUMBER_SCHEMA, "description": "deg, east positive"},
    "altitude": {**NUMBER_SCHEMA, "description": "m, the depth's negative; 0 where that is not known"},
    "position_covariance": {"type": "array", "items": NUMBER_SCHEMA, "minItems": 9, "maxItems": 9},
    "position_covariance_type": {"title": "foxglove.PositionCovarianceType", "oneOf": [{"const": 0}]},
}
"""Properties of a ``foxglove.LocationFix`` with unknown covariance."""


def topic_of(name: str) -> str:
    """Return the topic whose messages hold a column."""
    if name == "quality":
        return FLAGS
    if name == "sensor_temperature" or name.startswith("mag"):
        return RAW
    if name not in COLUMNS:
        return OTHER_TOPIC
    return FIELD if COLUMNS[name].units == "nT" else VEHICLE


def chunks(path: Path, rows: int) -> Iterator[xr.Dataset]:
    """Yield a file of :class:`FileWriter` in pieces of at most `rows` rows; the whole file is in memory."""
    try:
        with path.open("rb") as file:
            whole = _read(path, make_reader(file, validate_crcs=True))
    except (McapError, msgspec.DecodeError, KeyError, ValueError, TypeError, EOFError) as error:
        reason = str(error) or type(error).__name__
        raise FormatError(path, f"expected a whole MCAP file of magbridge: {reason}") from None
    yield from sliced(whole, rows)


def _read(path: Path, reader: Any) -> xr.Dataset:
    attrs: dict[str, Any] = next((json.loads(one.metadata["attrs"]) for one in reader.iter_metadata()), {})
    columns: dict[str, dict[str, str]] = {}
    for schema in reader.get_summary().schemas.values():
        if schema.name.startswith(f"{PROFILE}."):
            columns |= json.loads(schema.data)["columns"]
    topics = {topic_of(name) for name in columns}
    found = [
        (message.log_time, msgspec.json.decode(message.data))
        for _, _, message in reader.iter_messages(topics=topics)
    ]
    stamps, row = np.unique(np.array([stamp for stamp, _ in found], np.int64), return_inverse=True)
    values = {name: np.full(len(stamps), np.nan) for name in columns}
    for k, (_, message) in zip(row.tolist(), found, strict=True):
        for name, value in message.items():
            if name in values:
                values[name][k] = value
    seconds, rest = np.divmod(stamps, 10**9)
    units = {name: described["units"] for name, described in columns.items()}
    meanings = {name: described["long_name"] for name, described in columns.items()}
    return deployment(path, seconds + rest * 1e-9, values, units, attrs, meanings)


class FileWriter:
    """Writer of successive deployments with the columns of the first."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("wb")
        self._writer: Any = Writer(self._file)
        self._writer.start(profile=PROFILE, library=PROFILE)
        self._topics: dict[str, tuple[int, list[str]]] = {}

    def append(self, dataset: xr.Dataset, *, first: bool) -> None:
        """Write the rows; if `first`, write attributes and schemas before.

        WriteError: a time before 1970, which MCAP cannot represent.
        """
        if first:
            attrs = json.dumps(plain_attrs(dataset.attrs))
            self._writer.add_metadata(PROFILE, {"attrs": attrs})
            self._announce({str(name): dataset[name].attrs for name in dataset.data_vars})
        time = dataset["time"].to_numpy()
        if len(time) and time[0] < 0.0:
            raise WriteError(self._path, "MCAP has no times before 1970")
        seconds = np.floor(time).astype(np.int64)
        rest = np.rint((time - seconds) * 1e9).astype(np.int64)
        rows = {topic: self._rows(dataset, names) for topic, (_, names) in self._topics.items()}
        for k, (sec, nsec) in enumerate(zip(seconds.tolist(), rest.tolist(), strict=True)):
            stamp = {"sec": sec, "nsec": nsec}
            for topic, (channel, _) in self._topics.items():
                if known := next(rows[topic]):
                    body = {"timestamp": stamp, **known}
                    at = sec * 10**9 + nsec
                    self._writer.add_message(channel, at, msgspec.json.encode(body), at, sequence=k)

    def close(self) -> None:
        """Write everything to the file and close it."""
        self._writer.finish()
        self._file.close()

    def _announce(self, columns: Mapping[str, Mapping[str, Any]]) -> None:
        """Register each topic that has columns, with its schema."""
        for topic in (RAW, FIELD, FLAGS, VEHICLE, OTHER_TOPIC):
            names = [name for name in columns if topic_of(name) == topic]
            if names:
                described = {name: {key: str(columns[name].get(key, "")) for key in ("units", "long_name")}
                        for name in names}  # fmt: skip
                properties = {
                    name: {**NUMBER_SCHEMA, "description": f"{one['units']}, {one['long_name']}"}
                    for name, one in described.items()
                }
                if topic == FLAGS:
                    properties |= {flag: {"type": "boolean"} for flag in _flags(0)}
                title = f"{PROFILE}.{topic[1:].title()}"
                self._register(topic, title, {"timestamp": WHEN, **properties}, names, described)
        if {"latitude", "longitude"} <= columns.keys():
            self._register(POSITION_TOPIC, "foxglove.LocationFix", LOCATION, [], {})

    def _register(
        self,
        topic: str,
        title: str,
        properties: Mapping[str, Any],
        names: list[str],
        described: Mapping[str, Any],
    ) -> None:
        schema = {"title": title, "type": "object", "properties": properties, "columns": described}
        number = self._writer.register_schema(title, "jsonschema", json.dumps(schema).encode())
        self._topics[topic] = self._writer.register_channel(topic, "json", number), names

    def _rows(self, dataset: xr.Dataset, names: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Yield the known values of each row in columns `names`; without names, its position as a fix."""
        if not names:
            yield from _fixes(dataset)
            return
        for values in zip(*(dataset[name].values.tolist() for name in names), strict=True):
            known = {name: value for name, value in zip(names, values, strict=True) if abs(value) < np.inf}
            if "quality" in known:
                known |= _flags(int(known["quality"]))
            yield known


def _flags(bits: int) -> dict[str, bool]:
    return {str(flag.name).lower(): bool(bits & flag) for flag in Quality}


def _fixes(dataset: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield each row's position as a LocationFix; empty if it is unknown."""
    empty: FloatArray = np.full(dataset.sizes["time"], np.nan)
    depth = dataset["depth"].to_numpy() if "depth" in dataset else empty
    places = (dataset["latitude"].to_numpy(), dataset["longitude"].to_numpy(), -np.nan_to_num(depth))
    for latitude, longitude, altitude in zip(*(place.tolist() for place in places), strict=True):
        known = abs(latitude) < np.inf and abs(longitude) < np.inf
        place = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        nothing = {"position_covariance": [0.0] * 9, "position_covariance_type": 0}
        yield {"frame_id": "WGS84", **place, **nothing} if known else {}
