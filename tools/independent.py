"""Common part of the worlds that share no physics with ``sitl``: logs, calibrations, scores and tables.

Nothing in this module is physics, except the rotation of a vector by an attitude. :mod:`study.names` explains
the columns of the table. *Foreign* effects are not in the table of causes, so any name for them is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from studies import Column, Row, Study, show
from study.names import judge

from magbridge import Calibration, diagnose, fit, observations
from magbridge.arrays import FloatArray

UNITS = {
    "mag_x": "nT", "mag_y": "nT", "mag_z": "nT", "reference_field": "nT", "roll": "deg", "pitch": "deg",
    "heading": "deg", "latitude": "deg", "longitude": "deg", "depth": "m", "battpos": "mm", "vbd": "cc",
    "ballast": "in", "sensor_temperature": "degC", "motor_current": "A", "fin": "deg",
}  # fmt: skip


@dataclass(frozen=True)
class Log:
    """Telemetry columns of a log, (n,) each, and the true field in body axes (n, 3), nT."""

    columns: dict[str, FloatArray]
    body: FloatArray

    @property
    def time(self) -> FloatArray:
        """Times of the samples (n,), s since 1970 UTC."""
        return self.columns["time"]

    @property
    def hours(self) -> FloatArray:
        """Time since the first sample (n,), h."""
        return np.asarray((self.time - self.time[0]) / 3600.0)

    def dataset(self, readings: FloatArray, reference: FloatArray | float = 0.0) -> xr.Dataset:
        """Return the log with readings (n, 3), nT, and an error of the reference field, nT."""
        columns = self.columns | dict(zip(("mag_x", "mag_y", "mag_z"), readings.T, strict=True))
        if "reference_field" in columns:
            columns["reference_field"] = columns["reference_field"] + reference
        variables = {
            name: ("time", values, {"units": UNITS[name]})
            for name, values in columns.items()
            if name != "time"
        }
        return xr.Dataset(variables, {"time": self.time}, {"source": "another world"})

    def visible(self, effect: FloatArray) -> FloatArray:
        """Return the part of an effect (n, 3) along the field, which changes the total field (n,), nT."""
        unit = self.body / np.linalg.norm(self.body, axis=1)[:, None]
        return np.asarray(np.sum(effect * unit, axis=1))


def rotated(columns: dict[str, FloatArray], field: FloatArray) -> FloatArray:
    """Rotate a field (n, 3) from north-east-down to body axes, by heading, pitch and roll."""
    roll, pitch, heading = (np.radians(columns[name]) for name in ("roll", "pitch", "heading"))
    n, e, d = field.T
    x, y = np.cos(heading) * n + np.sin(heading) * e, np.cos(heading) * e - np.sin(heading) * n
    x, d = np.cos(pitch) * x - np.sin(pitch) * d, np.sin(pitch) * x + np.cos(pitch) * d
    return np.stack([x, np.cos(roll) * y + np.sin(roll) * d, np.cos(roll) * d - np.sin(roll) * y], axis=1)


def along(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a series (n,) along a random axis, (n, 3)."""
    axis = rng.normal(size=3)
    return np.outer(x, axis / np.linalg.norm(axis))


def calibrated(runs: xr.Dataset, masses: Sequence[str] = ("battpos", "vbd")) -> Calibration:
    """Return the calibration that is fitted to the log of calibration runs."""
    return fit(observations(runs, masses)).calibration


def diagnosed(name: str, log: xr.Dataset, calibration: Calibration, own: Collection[str]) -> list[Row]:
    """Diagnose a log with the hidden effect `name`; return the row. `own` are the causes of the table."""
    judged = judge(diagnose([log], calibration).diagnosis, [name] * bool(name))
    row: Row = {"kind": "foreign" if name else "nothing", "hidden": name, "named": ", ".join(judged["named"])}
    row["name"] = float(bool(judged["named"]))
    if name in own:
        row |= {key: float(judged[key]) for key in ("right", "in_set", "alone", "second")} | {"kind": "cause"}
    return [row]


def main(run: Callable[[int, float], list[Row]], cases: int, doc: str | None) -> None:
    """Run the cases of a world, and print the counts of the names."""
    sources = {
        "a name": "name", "right": "right", "in the set": "in_set", "alone": "alone", "a second": "second",
    }  # fmt: skip
    columns = {heading: Column(source, np.mean, ".0%") for heading, source in sources.items()}
    rows = Study(run, ("kind",), columns).main(doc, cases=cases, first=0, snr=25.0)
    show(rows[["hidden", "named"]].to_string())
