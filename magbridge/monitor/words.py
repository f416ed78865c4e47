"""Convert the state of a bridge to the texts that the page shows."""

from __future__ import annotations

import time
from enum import IntEnum
from math import exp, hypot, isfinite, nan, sqrt
from typing import Any

from magbridge.calibration.scalar import DISAGREEMENT_SIGMA
from magbridge.field.geodesy import worse_axis
from magbridge.learning.judge import JUDGE_MEMORY_SAMPLES
from magbridge.mavlink.enums import (
    MAG_CAUSE,
    MAG_LEARNING_STATE,
    MAG_LOG_STATE,
    MAG_NAVIGATION_STATE,
    MAG_PORT_STATE,
)
from magbridge.monitor.state import BridgeState
from magbridge.records import Quality

SILENT, SLOW = 3.0, 30.0
"""Silence after which a stream is reported as missing, s: `SILENT` for the whole bridge, which sends every
second. For field and status it is three of their intervals, but at least `SILENT` and at most `SLOW`."""
FLAG_TEXTS = {
    "stale_telemetry": "A parameter of the calibration is old, missing or NaN",
    "extrapolated": "A parameter is outside the calibrated range",
    "moving": "A mass is moving",
    "saturated": "A channel is at the end of its range",
    "uncalibrated": "No calibration, or one of another sensor",
    "offset_suspect": "The sensor was power-cycled since its calibration",
    "no_boresight": "The vector is in sensor axes; only its magnitude is calibrated",
    "gap": "Samples are missing",
    "implausible": "It cannot be the Earth's field here, or something is broken",
    "late_join": "Sample and telemetry may not be of one time",
    "unexplained": "The calibration no longer explains the field",
}
ROUTINE = {"moving", "no_boresight", "late_join"}
"""Flags that also occur in a mission without faults: the page shows them, but they raise no alarm."""
STARTING = 15.0
"""Time after the first message during which silence and port states raise no alarm, s."""
MAX_ALARM_TIME_S = 4_102_444_800
"""Latest start of an alarm (in 2099), s since 1970."""
NORMAL_95 = 1.96
"""Half width of the 95 % interval of a normal variable, in standard deviations."""
MAX_PLAIN_NUMBER = 1e9
"""Value from which a number is written with a power of ten."""
LOSS_TEXTS = {
    "Samples lost at the sensor": "samples_lost",
    "Bad frames from the sensor": "sensor_frames_bad",
    "Bytes skipped from the sensor": "sensor_bytes_skipped",
    "Frames lost from the autopilot": "link_frames_lost",
    "Bytes skipped from the link": "link_bytes_skipped",
    "Frames with a wrong signature": "link_refused",
    "Records lost by the log": "log_lost",
}


def duration(seconds: float) -> str:
    """Return the text of a duration in s, min or h."""
    unit, size = next(((u, s) for u, s in (("h", 3600), ("min", 60)) if seconds >= 2 * s), ("s", 1))
    return f"{max(seconds, 0.0) / size:.0f} {unit}"


def silence(state: BridgeState, now_s: float) -> str:
    """Return which of messages, field and status are missing, and since when; empty if none is."""
    if _late(state.received_at, 0.0, now_s):
        return _unheard("nothing", state.received_at, now_s)
    missing = []
    if _late(state.sampled, state.interval, now_s):
        missing.append(_unheard("no field", state.sampled, now_s))
    if state.status and _late(state.reported, state.report_interval, now_s):  # a bridge may omit the status
        missing.append(_unheard("no status", state.reported, now_s))
    return "; ".join(missing)


def _late(received: float, interval: float, now_s: float) -> bool:
    """Return True if a stream is late: silent for 3 intervals (s), within `SILENT` and `SLOW`."""
    return now_s - received > max(SILENT, min(3 * interval, SLOW))


def _unheard(stream: str, received: float, now_s: float) -> str:
    return f"{stream} heard for {duration(now_s - received)}" if isfinite(received) else f"{stream} heard yet"


def measured(state: BridgeState) -> dict[str, tuple[str, str]]:
    """Return the texts of the field: name of a quantity -> its value and its 2-sigma, nT."""
    get = state.field.get
    shown = {"Total field": _number(get("total_field", nan), ".2f", 2 * get("total_field_sigma", nan))}
    shown["Anomaly"] = _number(get("anomaly", nan), "+.2f")
    for name, axis in {"Forward": "x", "Starboard": "y", "Down": "z"}.items():
        shown[name] = _number(get(axis, nan), ".1f", 2 * get(f"sigma_{axis}", nan))
    return shown


def current_heading(field: dict[str, Any]) -> tuple[float, float, str] | None:
    """Return heading and 1-sigma (deg), and "true" or "magnetic"; None if `field` has no heading."""
    sigma = field.get("heading_sigma", 0.0)
    if not (isfinite(sigma) and sigma > 0.0):
        return None
    true, magnetic = field["heading"], field["magnetic_heading"]
    if isfinite(true):
        return true % 360.0, sigma, "true"
    return (magnetic % 360.0, sigma, "magnetic") if isfinite(magnetic) else None


def heading_text(field: dict[str, Any]) -> str:
    """Return the text of the heading, its reference and its 2-sigma, deg."""
    found = current_heading(field)
    if found is None:
        return "No heading: it needs a boresight and the autopilot's ATTITUDE"
    heading, sigma, reference = found
    return f"{round(heading, 1) % 360.0:05.1f}\N{DEGREE SIGN} {reference} ± {2.0 * sigma:.1f}\N{DEGREE SIGN}"


def sensor_rows(state: BridgeState, now_s: float) -> dict[int, dict[str, tuple[str, bool]]]:
    """Return the items of each of several sensors: number -> name -> text, and True if it is normal."""
    if len(state.sensors) < 2:
        return {}
    first = next(iter(state.sensors.values()))
    rows = {}
    for sensor in state.sensors.values():
        get, report = sensor.field.get, sensor.report.get
        total = _number(get("total_field", nan), ".2f", 2.0 * get("total_field_sigma", nan))
        value, sigma = (nan, nan) if sensor is first else sensor.difference(first)
        line = report("state", MAG_PORT_STATE.OK)
        is_late = _late(sensor.sampled, sensor.interval, now_s)
        text = "no samples" if is_late and line == MAG_PORT_STATE.OK else _word(MAG_PORT_STATE, line)
        difference = " ".join(_number(value, "+.2f", 2.0 * sigma)).strip()
        rate = _figure(report("sample_rate", nan), ".2f", "Hz")
        rows[sensor.number] = {
            "Total field": (" ".join(total).strip(), True),
            f"Minus {first.label}": (difference, not abs(value) > DISAGREEMENT_SIGMA * sigma),
            "Line": (f"{text}, {rate}", line == MAG_PORT_STATE.OK and not is_late),
            "Flags": (Quality(get("flags", 0)).names() or "none", True),
        }
    return rows


def health(state: BridgeState, now_s: float) -> dict[str, tuple[str, bool]]:
    """Return the health of the bridge: name of an item -> its text, and True if it is normal."""
    # latency and telemetry age of an old field would mislead
    field = ({} if _late(state.sampled, state.interval, now_s) else state.field).get
    get = state.status.get
    sensor, autopilot, log = (get(f"{line}_state", 0) for line in ("sensor", "autopilot", "log"))
    known = state.field.get("calibration_id")
    calibration = "–" if known is None else f"{known:08x}" if known else "none"
    is_fresh = "stale_telemetry" not in state.flags
    return {
        "Sensor": (_word(MAG_PORT_STATE, sensor), sensor == MAG_PORT_STATE.OK),
        "Autopilot": (_word(MAG_PORT_STATE, autopilot), autopilot == MAG_PORT_STATE.OK),
        "Log": (_word(MAG_LOG_STATE, log), log in (MAG_LOG_STATE.OFF, MAG_LOG_STATE.OK)),
        "Sample rate": (_figure(get("sample_rate", nan), ".2f", "Hz"), True),
        "Latency": (_figure(1e3 * field("latency", nan), ".1f", "ms"), True),
        "Telemetry age": (_figure(field("telemetry_age", nan), ".1f", "s"), is_fresh),
        "Calibration": (calibration, True),
        "Uptime": (duration(get("uptime", 0)), True),
    }


def losses(state: BridgeState) -> dict[str, tuple[str, bool]]:
    """Return the losses of bridge and link: name of an item -> its text, and True if it is normal."""
    counts = {name: state.status.get(counter, 0) for name, counter in LOSS_TEXTS.items()}
    missed = f"{_figure(state.lost)} of {_figure(state.lost + state.received)}"
    return {
        "Messages lost on the link": (missed, not state.lost),
        # skipped bytes are normal: the bridge may join a stream in the middle of a frame
        **{name: (_figure(count), not count or name.startswith("Bytes")) for name, count in counts.items()},
    }


def whereabouts(state: BridgeState, now_s: float) -> dict[str, tuple[str, bool]]:
    """Return the state of the position filter: name of an item -> its text, and True if it is normal."""
    get = state.navigation.get
    mode = get("state", 0)
    nn, ne, ee = (get(f"covariance_{axes}", nan) for axes in ("nn", "ne", "ee"))
    sigma = worse_axis(nn, ne, ee) if nn + ee > 0.0 else nan
    two_sigma = 2.0 * sqrt(max(get("innovation_variance", nan), 0.0))
    innovation = " ".join(_number(get("innovation", nan), "+.1f", two_sigma))
    return {
        "State": (_word(MAG_NAVIGATION_STATE, mode), mode != MAG_NAVIGATION_STATE.LOST),
        "Position": (f"{get('lat', 0) * 1e-7:.5f}, {get('lon', 0) * 1e-7:.5f}", True),
        "1σ of the longer axis": (_figure(sigma, ".0f", "m"), True),
        "Innovation ± 2σ": (innovation, bool(get("accepted", 1))),
        "Bias ± 2σ": (" ".join(_number(get("bias", nan), "+.1f", 2.0 * get("bias_sigma", nan))), True),
        "Current": (_figure(hypot(get("current_north", nan), get("current_east", nan)), ".2f", "m/s"), True),
        "Last update": (f"{duration(now_s - state.navigated)} ago" if state.navigation else "–", True),
    }


def learnt(state: BridgeState) -> dict[str, tuple[str, bool]]:
    """Return the items of the learning panel: name -> text, and True if the value is normal."""
    get = state.learning.get
    causes = [cause for cause in MAG_CAUSE if get("causes", 0) & cause]
    since = time.gmtime(min(get("alarm_since", 0) * 1e-6, MAX_ALARM_TIME_S))
    size = _figure(get("alarm_amplitude", nan), ".0f", "nT")
    doubted = f"{size} since {time.strftime('%d %b %H:%M', since)} UTC"
    names = ", ".join(str(cause.name).lower().replace("_", " ") for cause in causes)
    errors = (_figure(get(f"rms_{which}", nan), ".2f", "nT") for which in ("first", "published"))
    return {
        "State": (_word(MAG_LEARNING_STATE, get("state", 0)), True),
        "Published": (_calibration(get("calibration_id", 0), get("first_calibration_id", 0)), True),
        "Error of prediction, first": (next(errors), True),
        "Error of prediction, published": (next(errors), True),
        "Not explained": (doubted if causes else "nothing", not causes),
        "Causes that fit": (names or "–", not causes),
        "Samples learned from": (f"{get('samples', 0):,}", True),
        "Error of prediction, learned so far": (_figure(get("rms_learned", nan), ".2f", "nT"), True),
    }


def learned_worth(learning: dict[str, Any]) -> tuple[str, bool]:
    """Return a text that compares the learned calibration with the first, and True if it is better.

    The text states the ratio of their RMS prediction errors with its 95 % interval. Prediction errors are
    nearly white, so the logarithm of the RMS of n errors has the variance 1 / (2 n). The two RMS are treated
    as independent. n is the number of samples, limited to the memory of the bridge's RMS.
    """
    published, first = learning.get("calibration_id", 0), learning.get("first_calibration_id", 0)
    if published == first:
        return "The first calibration is published: accepting only acknowledges the alarm.", True
    before, after = learning.get("rms_first", nan), learning.get("rms_published", nan)
    count = min(int(learning.get("samples", 0)), JUDGE_MEMORY_SAMPLES)
    if not (before > 0.0 and after > 0.0 and count > 0):
        return "The errors of prediction are not known yet.", False
    ratio, spread = after / before, exp(NORMAL_95 / sqrt(count))
    low, high = ratio / spread, ratio * spread
    text = (
        f"Error of prediction {before:.2f} nT with the first calibration, {after:.2f} nT with the learned "
        f"one: {ratio:.2f} times (95 %: {low:.2f} to {high:.2f}, over {count} samples)."
    )
    if learning.get("better", 0.0) < 0.0:
        return f"{text} The last samples favour the first calibration.", False
    if high >= 1.0:
        return f"{text} It is not shown to be better.", False
    return text, True


def _calibration(published: int, first: int) -> str:
    return f"{published:08x}" + (", the first" if published == first else f"; the first is {first:08x}")


def conditions(state: BridgeState, now_s: float) -> dict[str, str]:
    """Return the conditions that raise an alarm, key -> text, for :meth:`.Alarms.update`."""
    wrong = {name: FLAG_TEXTS[name] for name in state.flags if name not in ROUTINE}
    starting = now_s - state.began < STARTING
    if (quiet := silence(state, now_s)) and not starting:
        wrong["silence"] = quiet.split(" for ")[0].capitalize()
    for line in ("Sensor", "Autopilot", "Log"):
        text, _ = health(state, now_s)[line]
        if state.status and not starting and text in {"silent", "lost", "failed"}:
            wrong[line] = f"{line}: {text}"
    for number, row in sensor_rows(state, now_s).items():
        if not number or starting:  # the first sensor is covered above
            continue
        label, (line, is_well) = state.sensors[number].label, row["Line"]
        if not is_well:
            wrong[f"sensor {number}"] = f"Sensor {label}: {line.split(',')[0]}"
        for name in FLAG_TEXTS.keys() & set(row["Flags"][0].split()) - ROUTINE:
            wrong[f"sensor {number} {name}"] = f"Sensor {label}: {FLAG_TEXTS[name]}"
    if state.navigation.get("state") == MAG_NAVIGATION_STATE.LOST:
        wrong["navigation"] = "The position by the field is lost"
    return wrong


def _word(states: type[IntEnum], value: int) -> str:
    """Return the name of a state, or "state N" for a value that only a newer bridge knows."""
    known = {int(state): state.name.lower().replace("_", " ") for state in states}
    return known.get(value, f"state {value}")


def _figure(value: float, form: str = ".0f", unit: str = "") -> str:
    """Return the text of a value with its unit and thousands separators; a dash if it is not finite."""
    return _number(value, form, unit=unit)[0]


def _number(value: float, form: str, two_sigma: float = nan, unit: str = "") -> tuple[str, str]:
    """Return the texts of a value with its unit, and of its 2-sigma; a dash and "" if not finite."""
    apart = form.replace(".", ",.")
    text, doubt = (
        plain.replace(",", "\N{NARROW NO-BREAK SPACE}").rstrip()
        for plain in (
            f"{value:{apart if abs(value) < MAX_PLAIN_NUMBER else '.3g'}} {unit}",
            f"± {two_sigma:{apart.lstrip('+') if abs(two_sigma) < MAX_PLAIN_NUMBER else '.3g'}}",
        )
    )
    return text if isfinite(value) else "–", doubt if isfinite(two_sigma) else ""
