"""The cases: which effects each part of the study hides, and what is recorded of a case's diagnosis."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from foreign import FOREIGN

from magbridge.arrays import FloatArray
from magbridge.diagnose.causes import CAUSES
from magbridge.diagnose.descriptions import Description, descriptions
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.findings import findings
from magbridge.diagnose.run import diagnose
from sitl.inject import EFFECTS, Hidden
from study.both import both
from study.deployment import CHARTS, SEEDS, Background, Injected, deployment_of
from study.improvement import DELAYS, harm, improvement
from study.noise import FLICKER, GLIDER, LOSSES, NOISES
from study.theory import Setting, ideal

Row = dict[str, Any]
NAMES = tuple(EFFECTS)
KNOWN = tuple(CAUSES)
"""Causes with a function of their own in the table; outliers are found by the noise model."""
LADDER = (4.0, 3.0, 5.0, 2.0, 6.0)
LOUD = (25.0, 100.0, 15.0, 50.0)
LASTING = (
    "temperature_offset", "temperature_scale", "current_field", "unmodelled_actuator", "actuator_order",
    "hysteresis", "eddy_current", "channel_skew", "filter_lag", "clock_offset", "nonlinearity",
    "pressure_offset", "reference_bias",
)  # fmt: skip
"""Causes that last to another deployment; the others are tied to a moment, a place or the range
of one log."""
NAMELESS = ("unknown", "seen", "foreign")
"""Parts in which the hidden effect is not among the causes of the table."""
PREDICTED = ("named", "ladder", "pair", *NAMELESS)
"""Parts for which theory predicts the outcome."""
STRANGE = ("jettison", "duet", "winch", "mooring")
"""Foreign effects made after the detector was frozen; its descriptions were not designed for them either."""
SEEN = (
    "pan", "loose", "corrosion", "pulsation", "needle", "thermostat", "perming", "staircase",
)  # fmt: skip
"""Foreign effects that were once made for this purpose, but before the detector was last improved."""
GOLDEN = 0.6180339887498949


class Part(NamedTuple):
    """A part of the study: its share of the cases, and its k-th case."""

    share: float
    entry: Callable[[int], Row]


def _null(k: int) -> Row:
    return {"names": (), "wanted": 0.0, "noise": NOISES[k % len(NOISES)]}


def _named(k: int) -> Row:
    return {"names": (NAMES[k % len(NAMES)],), "wanted": 8.0, "noise": ("white", "ar")[k // len(NAMES) % 2]}


def _ladder(k: int) -> Row:
    return _named(k) | {"wanted": LADDER[k // len(NAMES) % len(LADDER)]}


def _loud(k: int) -> Row:
    return _named(k) | {"wanted": LOUD[k // len(NAMES) % len(LOUD)]}


def _unknown(k: int) -> Row:
    names = (*KNOWN, *(name for name in FOREIGN if name not in STRANGE + SEEN))
    name = names[k % len(names)]
    return {"names": (name,), "wanted": 10.0, "noise": "white", "without": name if name in CAUSES else ""}


def _foreign(names: tuple[str, ...]) -> Callable[[int], Row]:
    return lambda k: {
        "names": (names[k % len(names)],), "wanted": 10.0, "noise": ("white", "ar")[k // len(names) % 2],
    }  # fmt: skip


def _pair(k: int) -> Row:
    a, b = np.random.default_rng([20131212, k]).choice(len(KNOWN), 2, replace=False)
    return {"names": (KNOWN[int(a)], KNOWN[int(b)]), "wanted": 10.0, "noise": ("white", "ar")[k % 2]}


def _gain(k: int) -> Row:
    return {"names": (LASTING[k % len(LASTING)],), "wanted": 20.0, "noise": "white"}


def _charted(k: int) -> Row:
    """As the paper's log: the reference is a map, the vehicle surfaces; a third of the cases hide nothing."""
    names = () if k % 3 == 0 else (LASTING[k % len(LASTING)],)
    return {
        "names": names, "wanted": LOUD[k % len(LOUD)] * bool(names), "noise": GLIDER,
        "reference": CHARTS[k // len(LOUD) % len(CHARTS)], "losses": "surfacing",
    }  # fmt: skip


def _flicker(k: int) -> Row:
    """In flicker noise, nothing or a cause that lasts; S/N is counted in white noise of the same RMS."""
    names = () if k % 3 == 0 else (LASTING[k % len(LASTING)],)
    return {"names": names, "wanted": 25.0 * bool(names), "noise": FLICKER}


PARTS: dict[str, Part] = {
    "null": Part(0.18, _null),
    "named": Part(0.22, _named),
    "ladder": Part(0.12, _ladder),
    "loud": Part(0.08, _loud),
    "unknown": Part(0.1, _unknown),
    "pair": Part(0.08, _pair),
    "gain": Part(0.07, _gain),
    "seen": Part(0.03, _foreign(SEEN)),
    "foreign": Part(0.04, _foreign(STRANGE)),
    "charted": Part(0.04, _charted),
    "flicker": Part(0.04, _flicker),
}


def losses(k: int) -> str:
    """Return how the k-th case of a part loses samples: one in three does, in one of the four ways.

    Multiples of the golden section keep no step with the cycles of causes, noises and sizes.
    """
    place = int(3 * len(LOSSES) * (GOLDEN * k % 1.0))
    return LOSSES[place] if place < len(LOSSES) else ""


def plan(cases: int, parts: tuple[str, ...] = tuple(PARTS), seed: int = 0) -> list[Row]:
    """Return the study's entries, the parts evenly mixed; a longer study contains the shorter one.

    Another `seed` hides the same causes at the same signal-to-noise in other vehicles, and draws everything
    else anew.
    """
    made = []
    # the last two share their hundred thousand: a seed has no more numbers
    for place, (name, part) in zip((*range(10), 9.5), PARTS.items(), strict=True):
        count = round(cases * part.share) if name in parts else 0
        made += [
            (
                (k + 0.5) / part.share,
                {"losses": losses(k)}
                | part.entry(k)
                | {"part": name, "number": SEEDS * seed + int(100_000 * place) + k},
            )
            for k in range(count)
        ]
    return [entry for _, entry in sorted(made, key=lambda item: item[0])]


def case(entry: Row) -> Row:
    """Hide the effects of an entry, diagnose the log, and return the outcome beside theory's prediction."""
    began = time.process_time()
    number, noise, names, without = entry["number"], entry["noise"], entry["names"], entry.get("without", "")
    deployment = deployment_of(number, noise, entry.get("reference", "true"))
    background = Background.of(deployment, number, noise, entry["losses"])
    hidden = [background.hide(name, entry["wanted"], number + 7919 * k) for k, name in enumerate(names)]
    whole = hidden[0].ds if len(hidden) == 1 else background.measure(*(one.hidden for one in hidden))
    ds = background.log(whole)
    table = {name: cause for name, cause in CAUSES.items() if name != without}
    result = diagnose([ds], deployment.calibration, training_logs=deployment.learned, causes=table)
    found = findings(result, table)
    row = entry | {
        "sizes": [one.hidden.size for one in hidden],
        "verdict": found["verdict"],
        "unexplained": found["unexplained"],
        "found": [
            [one["cause"], one["channel"], one["signal_to_noise"], [a["cause"] for a in one["alternatives"]]]
            for one in found["findings"]
        ],
        "p_value": result.outcome.p_value,
        "scores": _scores(found, names, whole),
        "theory": _theory(entry["part"], hidden, background, ds, result),
    }
    if entry["part"] == "gain":
        row["gain"] = improvement(hidden[0].hidden, background, ds, result)
    if entry["part"] == "charted":
        row["gain"] = harm(tuple(one.hidden for one in hidden), background, ds, result)
    return row | {"seconds": time.process_time() - began, "worker": os.getpid()}


def _scores(found: Row, names: tuple[str, ...], whole: xr.Dataset) -> list[float]:
    """Return (value - truth) / sigma of each parameter of known truth, if named; positive if too large."""
    truth = json.loads(whole.attrs["truth"])
    own = [f["parameters"] for f in found["findings"] if names == (f["cause"],)]
    if len(own) != 1:
        return []
    return [
        float(np.sign(truth[name]) * (p["value"] - truth[name]) / p["sigma"])
        for name, p in own[0].items()
        if name in truth and p["sigma"]
    ]


def _theory(
    part: str, hidden: list[Injected], background: Background, ds: xr.Dataset, result: Diagnosis
) -> list[dict[str, Any]]:
    """Return theory's prediction for a case of one hidden effect, or of two at once."""
    names = [one.hidden.name for one in hidden]
    if part not in PREDICTED or "outliers" in names:  # nothing else comes one by one
        return []
    late = next((one for one in hidden if one.hidden.name in DELAYS), hidden[0])
    others = {
        other: alike(other, late, background)
        for other in DELAYS
        if late.hidden.name in DELAYS and other not in names
    }
    free: list[Description] = []
    if part in NAMELESS:
        tones = CAUSES[names[0]].candidates(result.problem) if names[0] == "interference_tone" else []
        free = descriptions(result.problem, result.outcome.null, *tones[:1])
    setting = Setting(CAUSES, result.outcome.look_elsewhere, free, others)
    if len(hidden) > 1:
        return [both(hidden, background, ds, setting)]
    return [ideal(hidden[0], background, ds, setting)]


def alike(other: str, late: Injected, background: Background) -> FloatArray:
    """Signature of the other delay cause, at this delay, in the log that hides `late`, of a possible sign.

    A field that is late looks like a clock that is early, except where a mass starts or stops within the
    delay of a sample. There the telemetry of an early clock shows the motion one delay earlier, when a filter
    has covered ``1 - 1/e`` of its response; so, with the same telemetry, 1/e of the two signatures'
    difference remains. The telemetry of a log whose filter lags fits an early clock just as well.
    """
    d = late.signature
    if other == "clock_offset":
        return d
    f = background.show(Hidden(other, late.hidden.size, background.number)).signature
    return d + np.exp(-1.0) * (f - d) if f @ d > 0.0 else f
