"""`dappled open` in a browser: over a recording there is nothing to fire, to set or to wait for, and all to look at."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.system.browsing import SCREENSHOTS, Daemon, opened, until, until_text

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SIZES = [(390, 844), (844, 390), (1024, 600), (1280, 800)]
LIVE_ONLY = ("#verdict", "#shoot", "#interval-go", "#interval-stop", "#tab-live", "#counters", "#settings", "#clock")

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.alone, pytest.mark.usefixtures("leave")]


def url(command: subprocess.Popen[str]) -> str:
    """Where the page is, once the command says it."""
    assert command.stdout is not None
    return str(json.loads(command.stdout.readline())["url"]).rstrip("/") + "/"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """The example flight, opened."""
    cache = tmp_path_factory.mktemp("cache")
    with subprocess.Popen(
        [sys.executable, "-m", "dappled", "open", "--no-browser", "--json"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
    ) as command:
        try:
            yield Daemon(url(command), cache, command)
        finally:
            command.send_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("width", "height"), [SIZES[0], *(pytest.param(*size, marks=pytest.mark.long) for size in SIZES[1:])]
)
def test_a_recording_is_looked_at_and_nothing_on_its_page_waits_for_a_daemon(
    chromium: Browser, recording: Daemon, width: int, height: int
) -> None:
    phone = min(width, height) < 500
    size = {"width": width, "height": height}
    watched = opened(chromium, recording, size, log_in=False, is_mobile=phone, has_touch=phone)
    page = watched.page
    page.wait_for_selector("#gl:not([hidden])")
    asked = page.evaluate("performance.getEntriesByType('resource').map((one) => one.name)")
    looked_at = {found[1] for name in asked if (found := re.search(r"/api/frames/(\d+)/(?!thumb|map)", name))}
    newest = page.get_attribute("#strip > :first-child", "data-frame")
    assert looked_at == {newest}, "only the frame that is shown is decoded for the page"
    until(page, "document.querySelectorAll('#strip img').length >= 3")
    until(page, "/^recording/.test(document.querySelector('#contact').textContent)")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"recording-{width}x{height}.png")
    page.screenshot(path=SCREENSHOTS / f"recording-{width}x{height}-whole.png", full_page=True)
    assert [name for name in LIVE_ONLY if page.is_visible(name)] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for name in ("#gl", "#strip", "#tab-refocus", "#tab-views", "#tab-slices", "#tab-spectrum"):
        box = page.locator(name).bounding_box()
        assert box is not None, name
        assert name == "#strip" or box["y"] + box["height"] <= height, (name, box)
    picture = page.locator("#gl").bounding_box()
    assert picture is not None
    assert picture["height"] >= 0.4 * min(width, height)
    first = until_text(page, "#map-text", "^frame ")
    page.locator("#strip > *").first.click()
    until(page, f"document.querySelector('#map-text').textContent !== {json.dumps(first)}")
    for tab in ("views", "slices", "spectrum"):
        page.click(f"#tab-{tab}")
        page.wait_for_selector(f'#tab-{tab}[aria-selected="true"]')
    page.click("#tab-full")
    page.wait_for_selector('#frame-box[data-full] #picture[data-kind="full"]')
    sides = page.evaluate(
        "(({ naturalWidth, naturalHeight, clientWidth, clientHeight }) =>"
        " [naturalWidth, naturalHeight, clientWidth, clientHeight])(document.querySelector('#picture'))"
    )
    assert sides == [922, 694, 922, 694], "a pixel of the sensor is one of the page"
    until(page, "/^922 × 694 px without the mask's shadow/.test(document.querySelector('#caption').textContent)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.screenshot(path=SCREENSHOTS / f"recording-{width}x{height}-full.png")
    page.click("#tab-views")
    page.wait_for_selector("#frame-box:not([data-full]) #picture[data-kind='views']")
    until_text(page, "#facts", "(?i)verdict")
    assert watched.wrong == []


@pytest.mark.long
def test_a_recording_whose_command_has_ended_says_so(chromium: Browser, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "dappled", "open", "--no-browser", "--json"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
    ) as command:
        daemon = Daemon(url(command), tmp_path, command)
        page = opened(chromium, daemon, {"width": 1024, "height": 600}, log_in=False).page
        page.wait_for_selector("#gl:not([hidden])")
        command.send_signal(signal.SIGINT)
    until(page, "document.querySelector('#contact').textContent === 'no answer: has dappled open ended?'")
    assert page.get_attribute("#contact", "data-state") == "lost"
