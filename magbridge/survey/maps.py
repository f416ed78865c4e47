"""From a gridded survey to its map, and to files of the map, the tracks and the crossovers."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from magbridge.arrays import FloatArray
from magbridge.field.continuation import continued, raised
from magbridge.field.geodesy import metres_per_degree, offset
from magbridge.field.grid import AnomalyGrid
from magbridge.files import atomic_path
from magbridge.survey.gridding import Gridded
from magbridge.survey.samples import Crossovers, Samples

__all__ = ["anomaly_map", "write_crossovers", "write_geotiff", "write_points", "write_tracks"]

A_LENGTH = 8.0
"""Nodes of a map to one length of its field."""
MAX_MAP_NODES = 250_000
"""Nodes of a map at most, unless a spacing is asked for."""
DRAWN_FIELDS = 100
"""Number of drawn fields that determine the sigma of a continued map, to 7 %."""
MAX_SIGMA_FRACTION = 0.95
"""Fraction of the field's size at which the sigma counts as unknown, and the map has a hole."""


def anomaly_map(
    gridded: Gridded,
    samples: Samples,
    *,
    spacing: float | None = None,
    altitude: float | None = None,
    name: str = "survey",
) -> AnomalyGrid:
    """Return the map of a survey, at its own height or continued to `altitude`, m above the ellipsoid.

    Downward, what the series leaves out counts in the sigma. The `spacing` of the nodes, m, is an eighth of
    the field's length if not given.
    """
    places = gridded.field.nodes.places
    inner = places[gridded.field.nodes.covers(places)]
    low, high = inner.min(axis=0), inner.max(axis=0)
    step = spacing or max(
        gridded.field.length / A_LENGTH, float(np.sqrt(np.prod(np.maximum(high - low, 1.0)) / MAX_MAP_NODES))
    )
    north, east = (np.arange(low[k], max(high[k], low[k] + 3.5 * step) + step, step) for k in range(2))
    at = np.stack(np.meshgrid(north, east, indexing="ij"), axis=-1).reshape(-1, 2)
    anomaly, sigma = gridded.evaluate(at)
    size = gridded.size * gridded.roughness.evaluate(at)
    hole = ~gridded.field.nodes.covers(at) | (sigma > MAX_SIGMA_FRACTION * size)
    anomaly[hole] = sigma[hole] = np.nan
    shape = len(north), len(east)
    origin = samples.origin
    per_latitude, per_longitude = metres_per_degree(origin[0])
    grid = AnomalyGrid(
        origin[1] + east / per_longitude,
        origin[0] + north / per_latitude,
        anomaly.reshape(shape),
        sigma.reshape(shape),
        altitude=-gridded.middle,
        name=name,
        sigma_length=gridded.field.length,
        level_sigma=samples.level_sigma,
    )
    return grid if altitude is None else _continued(grid, gridded, at, altitude)


def _continued(grid: AnomalyGrid, gridded: Gridded, nodes: FloatArray, altitude: float) -> AnomalyGrid:
    """Return a map at another altitude, m; `nodes` (n, 2) are its nodes' places, m.

    Its sigma is the spread of fields that the data leave open, each continued: errors smaller than the height
    cancel, and what lies beyond the survey's edge comes in from as far as the height.
    """
    there, missing, _ = continued(grid, -altitude)
    rise = raised(grid, altitude)
    drawn = [
        (rise(one.reshape(grid.anomaly.shape)) - there.anomaly) ** 2
        for one in gridded.draw(nodes, DRAWN_FIELDS)
    ]
    return there.replaced(sigma=np.hypot(np.sqrt(np.mean(drawn, axis=0)), missing))


VERTICES = 5_000
"""Largest number of vertices of a track."""
SCALE, TIE, KEYS, NODATA = 33550, 33922, 34735, 42113
"""TIFF tags: ModelPixelScale, ModelTiepoint, GeoKeyDirectory (GeoTIFF 1.1), and GDAL's NODATA."""
WGS84 = (1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, 1, 2048, 0, 1, 4326)
"""GeoKeys: geographic, a pixel is an area, EPSG:4326."""


def write_geotiff(grid: AnomalyGrid, path: Path) -> None:
    """Write a map's anomaly as a GeoTIFF, float32 on WGS84, holes as NaN.

    WriteError: the file cannot be written.
    """
    from PIL import Image, TiffImagePlugin  # noqa: PLC0415 - only here

    dx, dy = (float(axis[1] - axis[0]) for axis in (grid.longitude, grid.latitude))
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    corner = (float(grid.longitude[0]) - 0.5 * dx, float(grid.latitude[-1]) + 0.5 * dy)
    for tag, kind, value in (
        (SCALE, 12, (dx, dy, 0.0)),
        (TIE, 12, (0.0, 0.0, 0.0, *corner, 0.0)),
        (KEYS, 3, WGS84),
        (NODATA, 2, "nan"),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    with atomic_path(path) as temporary:
        image = Image.fromarray(np.ascontiguousarray(grid.anomaly[::-1], np.float32))
        image.save(temporary, format="TIFF", tiffinfo=tags)


def write_tracks(samples: Samples, path: Path) -> None:
    """Write every line's track, as GeoJSON or, where the suffix is .kml, as KML."""
    names = samples.names()
    tracks = {label: _track(samples, label) for label in np.unique(samples.line).tolist()}
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".kml":
            named = [(names[label], track) for label, track in tracks.items()]
            temporary.write_text(_kml(named), encoding="utf-8")
            return
        features = [
            {
                "type": "Feature",
                "properties": {"line": names[label], "tie": bool(samples.tie[samples.line == label].any())},
                "geometry": {"type": "LineString", "coordinates": track.round(7).tolist()},
            }
            for label, track in tracks.items()
        ]
        content = {"type": "FeatureCollection", "features": features}
        temporary.write_text(json.dumps(content), encoding="utf-8")


def write_crossovers(
    found: Crossovers, samples: Samples, old_misties: FloatArray, new_misties: FloatArray, path: Path
) -> None:
    """Write a row for each crossover: place, lines, and its mis-ties (m,), nT, before and after."""
    latitude, longitude = offset(*samples.origin, found.place[:, 0], found.place[:, 1])
    names = np.array(samples.names())
    lines = [names[samples.line[rows]] for rows in (found.first, found.second)]
    heads = ["longitude", "latitude", "line", "crossed", "before [nT]", "after [nT]"]
    columns: list[NDArray[Any]] = [longitude.round(7), latitude.round(7), *lines]
    columns += [old_misties.round(3), new_misties.round(3)]
    _write_csv(path, heads, columns)


def write_points(
    longitude: FloatArray,
    latitude: FloatArray,
    anomaly: FloatArray,
    sigma: FloatArray,
    level_sigma: float,
    path: Path,
) -> None:
    """Write predictions at points, (n,) each: deg, nT, their 1-sigma, and that of their common level."""
    heads = ["longitude", "latitude", "anomaly [nT]", "anomaly_sigma [nT]", "level_sigma [nT]"]
    level = np.full(len(anomaly), round(level_sigma, 3))
    _write_csv(path, heads, [longitude, latitude, anomaly.round(3), sigma.round(3), level])


def _write_csv(path: Path, heads: list[str], columns: Sequence[NDArray[Any]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(heads)
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))


def _track(samples: Samples, label: int) -> FloatArray:
    """Return longitude and latitude (v, 2) along a line, deg."""
    place = samples.place[samples.line == label]
    place = place[:: max(len(place) // VERTICES, 1)]
    latitude, longitude = offset(*samples.origin, place[:, 0], place[:, 1])
    return np.stack([longitude, latitude], axis=1)


def _kml(tracks: Sequence[tuple[str, FloatArray]]) -> str:
    marks = "\n".join(
        f"<Placemark><name>line {escape(label)}</name><LineString><coordinates>"
        + " ".join(f"{x:.7f},{y:.7f}" for x, y in track.tolist())
        + "</coordinates></LineString></Placemark>"
        for label, track in tracks
    )
    header = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    return f"{header}\n{marks}\n</Document></kml>\n"
