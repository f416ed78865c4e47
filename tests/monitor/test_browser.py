"""Test the page in a real browser: its view, its keyboard control, and its text for a screen reader."""

import math
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from station import served

from magbridge.mavlink import Codec
from magbridge.records import Quality

pytest.importorskip("nicegui")
from magbridge.monitor.panels import DO, TUNABLES

WIDTHS = {"desktop": (1280, 900), "phone": (390, 844)}
FLAGS = int(Quality.STALE_TELEMETRY | Quality.GAP)
PATIENCE = 20_000
"""Time limit for the page on a busy computer, ms."""

SPIKES = 150, 200, 250
LEARNING = {"state": 3, "calibration_id": 0xABC, "first_calibration_id": 0xDEF, "samples": 500, "causes": 1}
ERRORS = {"rms_first": 12.0, "rms_published": 3.0, "better": 9.0}
ORDERS: list[float] = []
"""Values of MB_LEARN_CMD that the page has set."""


def feed(link: tuple[str, int], stop: threading.Event) -> None:
    """Send what two vehicles send, with three spikes, because UDP may lose one, and a mass that moves."""
    bridges, autopilot, ear = (Codec(1, 191), Codec(2, 191)), Codec(1, 1), Codec(0, 0)
    command = {"param_id": "MB_LEARN_CMD", "param_value": 0.0, "param_index": 1, "param_count": 2}
    begin = time.time() - 300.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        for k in range(100_000):
            us = round((begin + k if k < 300 else time.time()) * 1e6)
            place = {"lat": 495_000_000 + 200 * k, "lon": -579_000_000 + 300 * k}
            total = 52_000.0 + 5.0 * math.sin(k / 20.0) + (9_000.0 if k in SPIKES else 0.0)
            field = {"time_usec": us, "total_field": total, "total_field_sigma": 1.0}
            frames = [
                bridges[0].pack("MAG_FIELD", flags=FLAGS, **field),
                bridges[1].pack("MAG_FIELD", **{**field, "total_field": 41_000.0}),
                bridges[0].pack("MAG_RAW", time_usec=us, temperature=7.0),
                autopilot.pack("NAMED_VALUE_FLOAT", name="battpos", value=k // 40 % 2),
                autopilot.pack("GLOBAL_POSITION_INT", **place),
            ]
            if k % 50 == 0:
                covariance = {"covariance_nn": 9e3, "covariance_ne": 4e3, "covariance_ee": 5e3}
                frames.append(bridges[0].pack("MAG_NAVIGATION", state=2, **place, **covariance))
                frames.append(bridges[0].pack("STATUSTEXT", severity=4, text="<b>bold</b> ballast is stale"))
                value = {"param_id": "MB_SETTLE_TIME", "param_value": 4.0, "param_count": 2}
                frames += [bridges[0].pack("PARAM_VALUE", **one) for one in (value, command)]
                frames.append(bridges[0].pack("MAG_LEARNING", **LEARNING, **ERRORS))
                frames.append(bridges[0].pack("MAG_STATUS", uptime=k, sensor_state=1, log_state=1))
            with suppress(BlockingIOError):
                while data := sender.recv(65536):
                    for message in ear.parse(data):
                        if message.name == "PARAM_SET" and message["param_id"] == "MB_LEARN_CMD":
                            ORDERS.append(message["param_value"])
                            frames.append(bridges[0].pack("PARAM_VALUE", **command))
            for frame in frames:
                sender.sendto(frame, link)
            if stop.wait(0.002 if k < 300 else 0.5):
                return


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return the system's Chromium; skip the test if it is missing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = "chromium", "chromium-browser", "google-chrome"
    chromium = next(filter(None, map(shutil.which, names)), None)
    if chromium is None:
        pytest.skip("no Chromium on this computer")
    with playwright.sync_playwright() as player:
        opened = player.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    stop = threading.Event()
    with served() as (address, link):
        sender = threading.Thread(target=feed, args=(link, stop))
        sender.start()
        try:
            yield address
        finally:
            stop.set()
            sender.join()


@contextmanager
def visit(browser: Any, url: str, width: str = "desktop", scheme: str = "light") -> Iterator[Any]:
    """Yield the page once it shows the curve; an error that the page reports fails the test."""
    size = dict(zip(("width", "height"), WIDTHS[width], strict=True))
    page = browser.new_context(viewport=size, color_scheme=scheme, accept_downloads=True).new_page()
    page.set_default_timeout(PATIENCE)
    reports: list[str] = []
    page.on("pageerror", lambda error: reports.append(str(error)))
    page.goto(url)
    page.get_by_text("MB_SETTLE_TIME").wait_for()
    page.wait_for_function(f"{CHART}?.getOption()?.series?.[2]?.data?.length > 200")
    yield page
    assert reports == []
    page.context.close()


CHART = "magbridge.chart(document.querySelector('[data-chart]'))"


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everybody_can_read_it(browser: Any, url: str, width: str, scheme: str) -> None:
    """No violation that axe finds; nothing is wider than the window; no error."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    with visit(browser, url, width, scheme) as page:
        found = axe.Axe().run(page).response["violations"]
        assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= WIDTHS[width][0]
        assert page.evaluate("document.body.classList.contains('body--dark')") is (scheme == "dark")


def test_a_reader_zooms_with_keys_and_finds_the_day_again_after_a_reload(browser: Any, url: str) -> None:
    with visit(browser, url) as page:
        before = page.evaluate(f"{CHART}.getOption().series[2].data.length")
        page.locator("[data-chart]").first.focus()
        page.keyboard.press("+")
        zoom = page.evaluate(f"{CHART}.getOption().dataZoom[0]")
        assert (zoom["start"], zoom["end"]) == pytest.approx((25, 75))
        page.wait_for_timeout(1500)  # new samples do not change the selected time span
        assert page.evaluate(f"{CHART}.getOption().dataZoom[0].start") == pytest.approx(25)
        page.keyboard.press("0")
        assert page.evaluate(f"{CHART}.getOption().dataZoom[0].end") == 100
        page.reload()
        page.wait_for_function(f"{CHART}?.getOption()?.series?.[2]?.data?.length >= {before}")
        page.get_by_role("button", name="24 h").click()
        page.wait_for_function(f"{CHART}.getOption().series[2].data.length < 10")


def test_a_spike_is_marked_and_does_not_flatten_the_axis(browser: Any, url: str) -> None:
    with visit(browser, url) as page:
        page.wait_for_function(f"{CHART}.getOption().series[3].data.length > 0")  # of the next drawing
        axis = page.evaluate(f"{CHART}.getOption().yAxis[0]")
        assert axis["max"] - axis["min"] < 100.0
        marks = page.evaluate(f"{CHART}.getOption().series[3].data")
        assert {round(mark["value"][2], -3) for mark in marks} == {61_000}


def test_alarms_vehicles_and_texts(browser: Any, url: str) -> None:
    with visit(browser, url) as page:
        seen = page.get_by_role("button", name=re.compile("Seen: A parameter of the calibration"))
        other = page.get_by_role("button", name=re.compile("Seen: Samples are missing")).element_handle()
        seen.click()
        seen.wait_for(state="detached")
        assert other.evaluate("button => button.isConnected")  # a click on it would not have been lost
        assert page.get_by_text("<b>bold</b> ballast is stale").count()  # as text, not as HTML
        page.get_by_role("button", name=re.compile("Vehicle 2, component 191")).click()
        page.get_by_text("41\u202f000.00").wait_for()


def test_a_learned_calibration_is_accepted_or_forgotten_after_a_question(browser: Any, url: str) -> None:
    assert DO in TUNABLES
    with visit(browser, url) as page:
        panel = page.get_by_role("region", name="Learning in flight")
        panel.get_by_text("offset step").wait_for()
        confirm = page.get_by_role("dialog")
        for name, value in (("Accept", 1.0), ("Forget", 2.0)):
            for answer in ("Cancel", name):
                panel.get_by_role("button", name=name).click()
                assert ("0.25 times (95 %: 0.23 to 0.27" in confirm.inner_text()) == (name == "Accept")
                assert value not in ORDERS
                confirm.get_by_role("button", name=answer).click()
                confirm.wait_for(state="detached")
            deadline = time.monotonic() + PATIENCE / 1000
            while value not in ORDERS:
                assert time.monotonic() < deadline
                page.wait_for_timeout(100)


def test_a_picture_and_a_report_are_handed_out(browser: Any, url: str, tmp_path: Path) -> None:
    with visit(browser, url) as page:
        with page.expect_download() as download:
            page.get_by_role("button", name="Picture").click()
        picture = tmp_path / "page.png"
        download.value.save_as(picture)
        data = picture.read_bytes()
        assert data.startswith(b"\x89PNG")
        height = int.from_bytes(data[20:24])
        assert height > 1500  # all charts, one below the other
        with page.expect_download() as download:
            page.get_by_role("button", name="Report").click()
        with ZipFile(BytesIO(Path(download.value.path()).read_bytes())) as archive:
            assert len(archive.read("samples.csv").splitlines()) > 200
            assert b"MB_SETTLE_TIME" in archive.read("parameters.csv")
