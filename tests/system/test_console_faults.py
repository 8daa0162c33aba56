"""The console's first screen in a browser, on a phone and a laptop, over records that a test makes: twelve faults, each
uncut with its code and what to do; a running series, what came of its requests, and old values."""

from __future__ import annotations

import io
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from dappled.cli import status
from dappled.daemon.console.feed import FeedState
from dappled.daemon.health import go_no_go
from dappled.daemon.health.standing import in_record
from dappled.daemon.vehicle_battery import VehicleBattery
from dappled.decode.geometry import Gnss
from dappled.findings import Finding, named, remedy, told
from tests.daemon.console.test_app import Rig, frame, rig
from tests.daemon.health.test_faults import BODY, FAULTS
from tests.daemon.health.test_record import HERE, S, record
from tests.daemon.pipeline.test_overlap import at, watch
from tests.system.browsing import DEADLINE_MS, SCREENSHOTS, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

__all__ = ["rig"]  # a fixture

SIZES = [(390, 844), (1280, 800)]
PICTURES = Path(__file__).parents[2] / "docs" / "pictures"
FAR = (264, 330, 512, 516)  # of first-screen.jpg: a picture to look at, in place of the vehicle's
STANDING = "performance.now = () => 60_000;"  # nothing that was heard gets old, however busy this machine is
SETTINGS = {"CAM_ISO": "200", "CAM_SHUTTERSPD": "1/1000", "CAM_APERTURE": "8.0", "CAM_BATTERY": "80%"}
FLYING = {
    "vehicle": replace(HERE, gnss=Gnss(6, 19, None, None, None, None, None, age_ms=200.0)),
    "battery": VehicleBattery(24.8, 76, low=False),
    "frame_bytes": 17e6,
    "body": BODY,
    "parameters": [{"name": name, "title": name, "value": one, "choices": ()} for name, one in SETTINGS.items()],
}

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.alone, pytest.mark.usefixtures("leave")]


def told_of(rig: Rig, folder: Path, *faults: str, **more: Any) -> list[Finding]:
    """Give the console the health record of a flight with these faults, and a photograph of 4 s ago."""
    changes = {name: value for fault in faults for name, value in FAULTS[fault][1].items()}
    changes |= {name: more.pop(name) for name in ("found", "overlap") if name in more}
    made = record(folder, **{**FLYING, **changes})
    rows = [{**one, "age_s": 21.0} for one in made["findings"]]
    rig.feed.health = {**made, "flight": "20261121T101503Z-1a2b3c4d", "interval": None, "findings": rows, **more}
    facts = {"histogram": [n * math.exp(-n / 9) for n in range(64)], "clipped_share": 0.001, "carriers_found": 24}
    of_slices = {**facts, "carriers": [], "carriers_from": "calibration", "shape": [2, 30, 40], "doubts": []}
    tag = {**frame(0), "utc_ns": made["utc_ns"] - 4 * S, "utc_sigma_ns": 10**5}
    rig.feed.frames[0] = FeedState(tag, np.zeros((3, 4), np.uint8), slices=of_slices)
    return in_record(made)


def opened(browser: Browser, rig: Rig, picture: bytes, width: int, height: int) -> Page:
    """The page with the frame's picture."""
    phone = width < 500
    context = browser.new_context(viewport={"width": width, "height": height}, is_mobile=phone, has_touch=phone)
    context.add_init_script(STANDING)
    page = context.new_page()
    page.route("**/api/frames/**", lambda route: route.fulfill(body=picture, content_type="image/jpeg"))
    page.goto(rig.url)
    page.wait_for_selector("#strip [data-frame] img")
    page.click("#tab-views")
    page.wait_for_selector('#picture[data-kind="views"]:not([hidden])')
    page.evaluate("scrollTo(0, 0)")
    return page


def on_screen(page: Page, *names: str) -> dict[str, float]:
    """The heights of these parts, all of which must be on the first screen as it is now."""
    assert page.viewport_size is not None
    heights = {}
    for name in names:
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None, name
        assert 0 <= box["y"] < box["y"] + box["height"] <= page.viewport_size["height"], (name, box)
        heights[name] = box["height"]
    return heights


@pytest.fixture(scope="module")
def picture() -> bytes:
    """A frame's picture."""
    drawn = io.BytesIO()
    with Image.open(PICTURES / "first-screen.jpg") as sheet:
        sheet.crop(FAR).save(drawn, "JPEG", quality=90)
    return drawn.getvalue()


def hears(page: Page, rig: Rig, found: Finding) -> None:
    """Publish the health record until the page has this finding: a subscription takes effect some time after it is
    asked for."""
    assert rig.feed.health is not None
    shows = f"document.querySelector('#verdict-age').textContent.startsWith({found.code + ', for '!r})"
    deadline = time.monotonic() + DEADLINE_MS / 1e3
    while not page.evaluate(shows):
        assert time.monotonic() < deadline, found
        rig.publisher.publish("health", rig.feed.health)
        page.wait_for_timeout(30)


def test_each_fault_is_on_the_first_screen_with_its_code_and_what_to_do(
    chromium: Browser, rig: Rig, picture: bytes, tmp_path: Path
) -> None:
    told_of(rig, tmp_path)
    page = opened(chromium, rig, picture, *SIZES[0])
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    for fault in FAULTS:
        (found,) = told_of(rig, tmp_path, fault)
        hears(page, rig, found)
        assert page.get_attribute("#verdict", "data-state") == go_no_go.state([found]), fault
        assert page.inner_text("#verdict-text") == str(named(found))
        assert page.inner_text("#verdict-todo") == str(remedy(found))
        item = page.locator(f'#checks [data-code="{found.code}"] span')
        assert item.inner_text() == f"{told(found)} {found.code}"
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            page.screenshot(path=SCREENSHOTS / f"fault-{fault.replace(' ', '-')}-{width}.png")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            cut = page.evaluate(
                """['verdict', 'verdict-text', 'verdict-todo'].filter((name) => {
                    const one = document.getElementById(name);
                    return one.scrollHeight > one.clientHeight + 1 && getComputedStyle(one).display !== 'inline';
                })"""
            )
            assert cut == [], f"{fault}, {width} px wide"
            on_screen(page, "verdict", "verdict-text", "verdict-todo", "shoot", "interval-stop")


def test_until_the_views_are_made_the_mean_picture_is_shown(
    chromium: Browser, rig: Rig, picture: bytes, tmp_path: Path
) -> None:
    told_of(rig, tmp_path)
    page = chromium.new_context(viewport={"width": 1280, "height": 800}).new_page()
    held: list[Route] = []

    def answer(route: Route) -> None:
        if route.request.url.endswith("views.json"):
            held.append(route)
        else:
            route.fulfill(body=picture, content_type="image/jpeg")

    page.route("**/api/frames/**", answer)
    page.goto(rig.url)
    page.wait_for_selector('#picture[data-kind="mean"]:not([hidden])')
    until(page, "document.querySelector('#caption').textContent === 'The mean picture. Its views are being made.'")
    assert held
    held[-1].fulfill(json={"error": "this frame has no views"}, status=422)
    until(page, "document.querySelector('#caption').textContent === 'The mean picture. this frame has no views'")


def test_too_fast_for_the_overlap_is_on_the_phone_s_first_screen_with_the_speed_that_would_do(
    chromium: Browser, rig: Rig, picture: bytes, tmp_path: Path
) -> None:
    flying = watch(0.7)
    flying.take(at(0, 0.0, 10.0))
    flying.take(at(1, 4.0, 11.0))
    fast = flying.trouble(11 * S)
    assert fast is not None
    (found,) = told_of(rig, tmp_path, found=[fast], overlap=flying.last(11 * S))
    page = opened(chromium, rig, picture, *SIZES[0])
    until(page, "document.querySelector('#verdict').dataset.state === 'caution'")
    assert page.inner_text("#verdict-text") == str(named(found))
    assert page.inner_text("#verdict-todo") == "fly at 2.4 m/s or slower"
    cell = page.locator("#instruments", has_text="overlap").first
    assert "50 %, 4.0 m apart" in " ".join(cell.inner_text().split())
    on_screen(page, "verdict", "verdict-text", "verdict-todo", "shoot", "interval-stop", "instruments")
    page.screenshot(path=SCREENSHOTS / "too-fast-390.png")


@pytest.mark.parametrize("size", SIZES)
def test_a_series_what_came_of_its_requests_and_old_values_are_on_the_first_screen(
    chromium: Browser, rig: Rig, picture: bytes, tmp_path: Path, size: tuple[int, int]
) -> None:
    width, _ = size
    shots = {"wished": 10, "safe": 2, "failed": 1, "pending": 7, "refused": 4, "lost": 2}
    began_ms = int(rig.feed.state()["token"].split("-")[1])
    series = {"taken": 9, "refused": 4, "began_ms": began_ms, "count": 20, "next_s": 3.0}
    found = told_of(rig, tmp_path, "no camera", "low disk", shots=shots, interval=series)
    page = opened(chromium, rig, picture, *size)
    until(page, "document.querySelector('#verdict').dataset.state === 'no-go'")
    until(page, "document.querySelector('#progress').textContent === '9 of 20, next in 3 s'")
    page.screenshot(path=SCREENSHOTS / f"series-{width}.png")
    heights = on_screen(page, "verdict", "verdict-todo", "shoot", "interval-stop", "progress", "instruments", "picture")
    assert heights["interval-stop"] >= (64 if width < 700 else 56)
    assert page.is_enabled("#interval-stop")
    assert page.inner_text("#verdict-text") == str(named(found[0]))  # the first of one list, which `status` has too
    assert page.inner_text("#verdict-age") == "camera.absent, for 21 s, and 1 more below"
    assert page.locator("#checks li").evaluate_all("(all) => all.map((one) => one.dataset.code)") == [
        one.code for one in found
    ]
    assert rig.feed.health is not None
    assert [line.rpartition("[")[2] for line in status.screen(rig.feed.health)[-2:]] == [
        f"{one.code}]" for one in found
    ]
    counted = page.locator("#counters dt, #counters dd").all_inner_texts()[:8]
    assert counted == ["taken", "9", "on disk", "2", "refused", "4", "lost", "3"]
    for name in ("ISO", "battery"):  # of a body that is away
        cell = page.locator("#instruments [data-old]", has_text=name).first
        assert cell.inner_text().split()[-2:] == ["21", "s"], name
    page.locator("#instruments").get_by_text("#0").wait_for()  # the newest photograph
    page.click("#interval-stop")  # the daemon's answer stands in place of the series
    until(page, "document.querySelector('#outcome').textContent === 'shot 0'")
    until(page, "document.querySelector('#progress').textContent === ''")
    assert rig.asked[-1]["do"] == "stop interval"
