"""Test the panel of in-flight calibration and its buttons in a browser, with a real bridge."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rig import Rig
from station import served

if TYPE_CHECKING:
    from playwright.sync_api import Locator

pytest.importorskip("nicegui")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
PATIENCE = 30_000
"""Time limit for the page on a busy computer, ms."""
HZ = 20
LAT, LON, FIELD = 49.52, -57.87, 51_900.0
"""Latitude and longitude of a place, deg, and strength of the Earth's field there, nT."""
SHIFT = np.array([14.0, -11.0, 13.0])
"""Change of the offset since the calibration, nT."""


class Turning:
    """Source of the readings of a turning and pitching vehicle, nT; `level` adds to the Earth's field."""

    def __init__(self) -> None:
        self.level, self._samples, self._rng = 0.0, count(), np.random.default_rng(2)

    def __call__(self, _: float) -> tuple[float, float, float]:
        """Return the reading of the next sample."""
        leg = next(self._samples) // 20
        yaw = 0.7 * leg + 0.1 * self._rng.normal()
        pitch = (0.45 if leg % 2 else -0.4) + 0.05 * self._rng.normal()
        x, y = 0.4 * np.cos(yaw), 0.4 * np.sin(yaw)
        level = np.array([x - 0.9 * pitch, y, 0.9 + pitch * x])
        x, y, z = (FIELD + self.level) * level / np.linalg.norm(level) + SHIFT + self._rng.normal(size=3)
        return float(x), float(y), float(z)


@pytest.fixture
def flying(tmp_path: Path) -> Iterator[tuple[Rig, Turning]]:
    """Run a bridge with in-flight calibration until the test ends."""
    more = f"[learning]\nenabled = true\nmax_rate = {HZ}.0\n"
    (folder := tmp_path / "rig").mkdir()
    rig, field, ended = Rig(folder, "udpin", more=more, hz=HZ), Turning(), threading.Event()
    autopilot, rig.fluxgate.field = rig.autopilot, field
    rig.config.write_text(rig.config.read_text().replace("[publish]", "[publish]\nMAG_LEARNING = 2"))

    def with_position(frame: bytes) -> list[bytes]:
        place = {"lat": round(LAT * 1e7), "lon": round(LON * 1e7)}
        return [frame, autopilot.pack("GLOBAL_POSITION_INT", time_boot_ms=autopilot.boot_us // 1000, **place)]

    with autopilot.retelling(with_position):
        rig.start()
        player = threading.Thread(target=rig.until, args=(ended.is_set, 300.0))
        player.start()
        try:
            yield rig, field
        finally:
            ended.set()
            player.join()
            rig.close()


def press(button: Locator, answer: Locator) -> None:
    """Press a button repeatedly until the page reacts, because a stalled computer may reload the page."""
    for _ in range(3):
        button.click()
        with suppress(playwright.TimeoutError):
            answer.first.wait_for(timeout=PATIENCE / 3)
            return
    pytest.fail("no answer")


def test_an_alarm_is_shown_accepted_and_forgotten(flying: tuple[Rig, Turning], browser: Any) -> None:
    """Onset, amplitude, causes and both predictions are shown; each button acts on the bridge."""
    rig, field = flying
    with served(url=rig.url.replace("udpin", "udpout")) as (address, _):
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(PATIENCE)
        page.goto(address)
        panel = page.get_by_role("region", name="Learning in flight")
        panel.get_by_text("learning", exact=True).wait_for()  # the state: nothing is published in a minute
        page.wait_for_timeout(5000.0)  # samples to learn from
        rig.set_parameter("MB_LEARN_FREEZE", 1.0)  # learning stops, so that the alarm stays
        panel.get_by_text("frozen", exact=True).wait_for()
        field.level = 60.0
        panel.get_by_text("offset step").wait_for()
        shown = dict(pairwise(panel.inner_text().splitlines()))
        since = time.strftime("%d %b", time.gmtime())
        assert re.fullmatch(rf"\d+ nT since {since} \d\d:\d\d UTC", shown["Not explained"])
        for which in ("first", "published"):
            assert float(shown[f"Error of prediction, {which}"].removesuffix(" nT")) > 1.0
        confirm = page.get_by_role("dialog")
        press(panel.get_by_role("button", name="Accept"), confirm)
        assert re.search(r"times \(95 %: \d|only acknowledges", confirm.inner_text())
        press(confirm.get_by_role("button", name="Cancel"), panel)
        press(panel.get_by_role("button", name="Accept"), confirm)
        press(confirm.get_by_role("button", name="Accept"), page.get_by_text("explained again: acknowledged"))
        press(panel.get_by_role("button", name="Forget"), confirm)
        press(confirm.get_by_role("button", name="Forget"), page.get_by_text("learning: all forgotten"))
        panel.get_by_text(re.compile("the first$")).wait_for()
        page.close()
    texts = {text.partition(" learned calibration")[0] for text in rig.texts()}
    announced = (
        "MB_LEARN_CMD = 1, set by 255:190",
        "accepted:",
        "explained again: acknowledged",
        "MB_LEARN_CMD = 2, set by 255:190",
        "learning: all forgotten",
    )
    assert texts.issuperset(announced)
