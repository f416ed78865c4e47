"""Test that a log in a random layout is read correctly or rejected with a question, never silently wrong."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from magbridge import logs
from magbridge.errors import FormatError

GPS = 315_964_800 - 18
"""Difference of Unix time and GPS time, s."""
SIGNS = (",", "."), (";", ","), (";", "."), ("\t", "."), ("|", ","), ("|", ".")
"""Field separator and decimal sign."""
PARTS = {"year": "%Y", "month": "%m", "day": "%d", "hour": "%H", "min": "%M"}
Stamps = Callable[[pd.DatetimeIndex, np.ndarray[Any, np.dtype[np.float64]]], dict[str, list[str]]]


def clock(times: pd.DatetimeIndex, pattern: str) -> list[str]:
    """Return the times by a pattern, whose seconds are the last, with milliseconds."""
    return [f"{one.strftime(pattern)}.{one.microsecond // 1000:03d}" for one in times]


def days(times: pd.DatetimeIndex, pattern: str) -> list[str]:
    return times.strftime(pattern).tolist()


def count(unit: float, since: float = 0.0, digits: int = 0) -> Callable[[Any], list[str]]:
    return lambda seconds: [f"{(one - since) / unit:.{digits}f}" for one in seconds]


STAMPS: dict[str, Stamps] = {
    "iso": lambda t, _: {"time": clock(t, "%Y-%m-%dT%H:%M:%S")},
    "two": lambda t, _: {"Date": days(t, "%Y-%m-%d"), "Time": clock(t, "%H:%M:%S")},
    "german": lambda t, _: {"Datum": days(t, "%d.%m.%Y"), "Uhrzeit": clock(t, "%H:%M:%S")},
    "english": lambda t, _: {"Date": days(t, "%d/%m/%Y"), "Time": clock(t, "%H:%M:%S")},
    "digits": lambda t, _: {"date": days(t, "%Y%m%d"), "UTC": clock(t, "%H%M%S")},
    "nmea": lambda t, _: {"date": days(t, "%d%m%y"), "time": clock(t, "%H%M%S")},
    "whole": lambda t, _: {"timestamp": clock(t, "%Y%m%d%H%M%S")},
    "of day": lambda t, s: {"date": days(t, "%Y%m%d"), "sod": count(1.0, digits=3)(s % 86_400)},
    "unix": lambda _, s: {"timestamp": count(1.0, digits=3)(s)},
    "ms": lambda _, s: {"time": count(1e-3)(s)},
    "us": lambda _, s: {"epoch": count(1e-6)(s)},
    "excel": lambda _, s: {"Date": count(86_400.0, -25_569 * 86_400, 10)(s)},
    "gps": lambda _, s: {"gps_time": count(1.0, GPS, 3)(s)},
    "week": lambda _, s: {
        "GPS Week": count(1.0)((s - GPS) // 604_800), "TOW": count(1.0, digits=3)((s - GPS) % 604_800),
    },
    "parts": lambda t, _: {
        **{name: days(t, one) for name, one in PARTS.items()}, "sec": clock(t, "%S"),
    },
    "boot, ms": lambda _, s: {"timestamp": count(1e-3, float(s[0]) - 5.0)(s)},
}  # fmt: skip
ASKED = "can be both", "in a unit that the file does not tell"
SINCE_A_START = {"boot, ms"}
UNITS = {" [nT]": 1.0, " (uT)": 1e-3, " [mG]": 1e-2, " (G)": 1e-5, "": 1e-3, " ": 1e-9}
"""Unit after the names of the axes, and its factor to nT; an empty text is not a unit."""
NAMES = "mag_{}", "Mag{}", "B{}", "imu.magnetic_field.{}", "RAW_IMU.{}mag"


def drawn(random: np.random.Generator) -> tuple[str, str, Any, Any]:
    """Return kind of times, text in a random layout, times (n,) and field (n, 3), nT."""
    kind = str(random.choice(list(STAMPS)))
    separator, decimal = SIGNS[random.integers(len(SIGNS))]
    rows, step = int(random.choice([3, 40])), float(random.choice([0.1, 1.0, 4.0]))
    starts = "2022-05-04T11:59:31", "2022-05-25T23:59:57", "2019-12-31T23:59:58"
    start = pd.Timestamp(str(random.choice(starts)))
    times = start + pd.to_timedelta(np.round(step * np.arange(rows), 3), unit="s")
    seconds = (times - pd.Timestamp(0)).total_seconds().to_numpy()
    turn = random.uniform(0, 6) + np.linspace(0, 3, rows)
    field = np.column_stack([20_000 * np.cos(turn), 15_000 * np.sin(turn), 43_000 + 900 * np.sin(2 * turn)])
    unit = str(random.choice(list(UNITS)))
    name = str(random.choice(NAMES))
    axes = {f"{name.format(axis)}{unit}": [f"{value:.7g}" for value in field[:, k] * UNITS[unit]]
            for k, axis in enumerate("xyz")}  # fmt: skip
    others = {"mode": ["AUTO"] * rows, "temp": [f"{20 + k % 3}.5" for k in range(rows)]}
    columns: dict[str, list[str]] = {}
    for part in random.permutation(3):
        columns |= (STAMPS[kind](times, seconds), axes, others)[part]
    written = {
        heading: [cell if "-" in cell[1:] and ":" in cell else cell.replace(".", decimal) for cell in cells]
        for heading, cells in columns.items()
    }  # fmt: skip
    preamble = str(random.choice(["", "# made\n", "Logger 3\n"]))
    lines = [separator.join(written), *map(separator.join, zip(*written.values(), strict=True))]
    if name.startswith("imu."):  # a topic of ROS has its y to port and its z up
        field = field * [1.0, -1.0, -1.0]
    return kind, preamble + "\n".join(lines) + "\n", seconds, field


@pytest.mark.parametrize("seed", range(4))
def test_a_layout_drawn_at_random_is_read_right_or_asked_about(seed: int, tmp_path: Path) -> None:
    random, read = np.random.default_rng(seed), 0
    for number in range(40):
        kind, text, seconds, field = drawn(random)
        path = tmp_path / f"{number}.csv"
        path.write_text(text)
        try:
            log = logs.read(path)
        except FormatError as error:
            if not any(words in str(error) for words in ASKED):
                raise
            continue
        read += 1
        if kind in SINCE_A_START:
            assert log.attrs["time_reference"] == "boot"
            seconds = seconds - seconds[0] + float(log["time"][0])
        np.testing.assert_allclose(log["time"], seconds, atol=2e-3, err_msg=text[:300])
        found = np.column_stack([log[f"mag_{axis}"] for axis in "xyz"])
        np.testing.assert_allclose(found, field, atol=0.02, err_msg=text[:300])
        assert log["temp"].values.tolist() == [20.5 + k % 3 for k in range(len(seconds))]
    assert read > 25
