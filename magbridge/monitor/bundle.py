"""A bug report in one file."""

from __future__ import annotations

import csv
import json
import platform
import time
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO, StringIO
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from magbridge.mavlink import spec
from magbridge.monitor.state import BridgeState
from magbridge.monitor.words import health, measured, whereabouts
from magbridge.version import __version__

__all__ = ["bundle"]

LIBRARIES = ("nicegui", "numpy", "msgspec", "pyserial")


def bundle(state: BridgeState, now_s: float, link: str) -> bytes:
    """Return a ZIP file of versions, condition, status texts, alarms, parameters and the last samples.

    Parameters
    ----------
    state : BridgeState
        Of the bridge that it is about.
    now_s : float
        s, of the receiver's clock.
    link : str
        Where the bridge was heard.
    """
    wall = time.time() - now_s

    def utc(moment: float) -> str:
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(wall + moment))

    about: dict[str, Any] = {
        "made": utc(now_s),
        "magbridge": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "libraries": {name: _version(name) for name in LIBRARIES},
        "link": link,
        "bridge": state.bridge,
        "measured": measured(state),
        "health": {name: text for name, (text, _) in health(state, now_s).items()},
        "navigation": {name: text for name, (text, _) in whereabouts(state, now_s).items()},
        "flags": {name: utc(since) for name, (since, _) in state.flags.items()},
        "MAG_STATUS": {name: repr(value) for name, value in state.status.items()},
    }
    files = {
        "about.json": json.dumps(about, indent=1, ensure_ascii=False),
        "texts.csv": _table(
            ["time", "severity", "text"],
            [[utc(received.time), received.severity, received.text] for received in state.texts],
        ),
        "alarms.csv": _table(
            ["since", "last", "active", "acknowledged", "count", "alarm"],
            [
                [utc(one.since), utc(one.last), one.active, one.acknowledged, one.count, one.text]
                for one in state.alarms
            ],
        ),
        "parameters.csv": _table(
            ["name", "value", "error"],
            [[name, repr(one.value), one.error] for name, one in sorted(state.parameters.items())],
        ),
        "samples.csv": _table(
            list(spec("MAG_FIELD").fields), [list(sample.values()) for sample in state.samples]
        ),
    }
    held = BytesIO()
    with ZipFile(held, "w", ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return held.getvalue()


def _table(names: list[str], rows: list[list[Any]]) -> str:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return text.getvalue()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
