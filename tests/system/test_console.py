"""The console in a real browser, in front of a whole simulated daemon: what a person on the field does and sees."""

from __future__ import annotations

import base64
import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.daemon.console import pictures
from dappled.daemon.console.pictures import Mosaic
from dappled.findings import Code, Finding, Subject, remedy, text
from dappled.products import opened as opening
from dappled.products.exports import light_files
from dappled.products.opened import OpenedFlight
from tests.system.browsing import (
    DEADLINE_MS,
    LAPTOP,
    PHONE,
    SCREENSHOTS,
    TOKEN,
    Daemon,
    client,
    opened,
    shoot,
    simulated,
    until,
    until_flown,
    until_text,
)
from tests.waiting import eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route  # not in the smaller environment

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.alone, pytest.mark.usefixtures("leave")]


def drawn(page: Page, disparity: float) -> NDArray[np.float64]:
    """What the graphics card drew after the slider was moved there."""
    coded = page.evaluate(
        """(value) => {
            const slider = document.querySelector('#disparity');
            slider.value = value;
            slider.dispatchEvent(new Event('input'));
            return document.querySelector('#gl').toDataURL('image/png');
        }""",
        disparity,
    )
    return grey(base64.b64decode(coded.partition(",")[2]))


def grey(data: bytes) -> NDArray[np.float64]:
    with Image.open(io.BytesIO(data)) as picture:
        return np.asarray(picture.convert("L"), dtype=np.float64)


def mosaic(daemon: Daemon, frame: int) -> Mosaic:
    """The same views as the browser's, had by another client."""
    with client(daemon) as one:
        layout = one.get(f"/api/frames/{frame}/views.json").raise_for_status().json()
        data = one.get(f"/api/frames/{frame}/views.jpg").raise_for_status().content
    return Mosaic(
        grey(data).astype(np.uint8),
        (layout["tile"][0], layout["tile"][1]),
        layout["scale"],
        np.array(layout["row_steps"]),
        np.array(layout["column_steps"]),
    )


def test_a_person_shoots_looks_and_focuses(chromium: Browser, daemon: Daemon) -> None:
    watched = opened(chromium, daemon, LAPTOP)
    page = watched.page
    until(page, "document.querySelector('#verdict-word').textContent === 'Go'")
    until(page, "document.querySelector('#verdict-text').textContent === 'all is well'")
    until(page, """!document.querySelector('#checks [data-state="caution"], #checks [data-state="no-go"]')""")
    frame = shoot(page)
    page.wait_for_selector("#gl:not([hidden])")
    views = mosaic(daemon, frame)
    inner = np.s_[12:-12, 12:-12]  # beyond the edges fewer views are averaged, and the two interpolate differently
    disparities = (-1.0, 0.0, 0.5, 2.0)
    ours = {disparity: pictures.refocused(views, disparity).astype(np.float64) for disparity in disparities}
    for disparity in disparities:
        theirs = drawn(page, disparity)
        assert theirs.shape == ours[disparity].shape
        apart = {other: np.abs(one - theirs)[inner].mean() for other, one in ours.items()}
        same = apart.pop(disparity)
        assert same < 1.0, f"disparity {disparity}"
        # The slider moves the focus; by how much depends on what lay below when the frame was taken.
        assert same < min(apart.values()) / 2, f"disparity {disparity}: {apart}"

    page.click("#autofocus")
    until_text(page, "#disparity-text", "α")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / "laptop-refocus.png")
    for tab in ("views", "slices", "spectrum"):
        page.click(f"#tab-{tab}")
        page.wait_for_selector(f'#picture[data-kind="{tab}"]:not([hidden])')
        page.screenshot(path=SCREENSHOTS / f"laptop-{tab}.png")
    # 24 carriers and the mean, each predicted
    until(page, "document.querySelectorAll('#overlay path').length === 25")
    until(page, "document.querySelectorAll('#overlay circle').length >= 12")
    until(page, "document.querySelectorAll('#log li').length >= 2")
    until_text(page, "#log", "safe")
    # A first frame's verdict may be unknown; what stands below it may not.
    until_text(page, "#facts", r"exposed\n(?=([^\n]*\n){9})(?![\s\S]*unknown)")
    page.keyboard.press("ArrowLeft")  # the tabs are one stop for the keyboard, and arrows go through them
    page.wait_for_selector('#tab-slices[aria-selected="true"]')

    # Pictures at full size are made now and then: while the newest frame is followed, the newest picture is shown.
    page.click("#tab-full:not([hidden])")
    page.wait_for_selector('#frame-box[data-full] #picture[data-kind="full"]')
    page.click("#shoot")
    page.wait_for_selector(f'#strip [data-frame="{frame + 1}"][aria-selected="true"] img')
    until_text(page, "#which", r"^frame \d+(, the newest that has one)?$")
    assert page.get_attribute("#tab-full", "aria-selected") == "true"
    page.uncheck("#follow")
    until_text(page, "#which", r"^frame \d+$")
    assert page.get_attribute("#tab-full", "aria-selected") == "true", "what is seen stays"
    assert watched.wrong == []


@pytest.mark.long
def test_the_slider_s_alpha_is_the_command_s(chromium: Browser, daemon: Daemon, tmp_path: Path) -> None:
    """What the page draws and names α is, of the command's pictures, most like the one at that α."""
    page = opened(chromium, daemon, LAPTOP).page
    frame = shoot(page)
    page.wait_for_selector("#gl:not([hidden])")
    disparities = (-0.4, 0.0, 1.0, 2.0)  # α about 0.97 to 1.17
    drawings, alphas = [], []
    for disparity in disparities:
        drawings.append(drawn(page, disparity))
        found = re.search(r"α (\S+)$", page.inner_text("#disparity-text"))
        assert found is not None
        alphas.append(found[1])
    (flight,) = (path for path in daemon.flights.iterdir() if path.is_dir())
    recorded = opening.open(flight)
    assert isinstance(recorded, OpenedFlight)
    light_files.save(tmp_path / "frame.npz", recorded[frame].light_field.field)
    pictures_of_the_command = []
    for alpha in alphas:
        out = tmp_path / f"{alpha}.npy"
        subprocess.run([sys.executable, "-m", "dappled", "refocus", "frame.npz", "--alpha", alpha, "-o", out],
                       cwd=tmp_path, check=True, capture_output=True, timeout=60)  # fmt: skip
        pictures_of_the_command.append(like_the_page(np.load(out), mosaic(daemon, frame)))
    for place, drawing in enumerate(drawings):
        alike = [likeness(drawing, picture) for picture in pictures_of_the_command]
        assert int(np.argmax(alike)) == place, (alphas, alike)
        assert alike[place] > 0.99


def like_the_page(image: NDArray[np.floating], views: Mosaic) -> NDArray[np.float64]:
    """A linear picture (h, w) or (h, w, 3) as the page shows it: grey, as small as its tiles, sRGB."""
    plain = image.mean(axis=-1) if image.ndim == 3 else image
    (height, width), step = views.tile, views.scale
    small = plain[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
    return pictures.encoded(small / pictures.level(small)).astype(np.float64)


def likeness(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Correlation of two pictures of fine detail, away from the edges, where fewer views are averaged."""
    inner = np.s_[16:-16, 16:-16]
    return float(np.corrcoef(one[inner].ravel(), other[inner].ravel())[0, 1])


@pytest.mark.long
def test_an_interval_runs_and_stops(chromium: Browser, daemon: Daemon) -> None:
    watched = opened(chromium, daemon, LAPTOP)
    page = watched.page
    before = int(page.locator("#counters dd").first.inner_text())
    page.fill("#interval-s", "0.5")
    page.fill("#interval-count", "0")
    page.click("#interval-go")
    until(page, "!document.querySelector('#interval-stop').disabled")
    assert page.is_disabled("#interval-go")
    until(page, f"Number(document.querySelector('#counters dd').textContent) >= {before + 2}")
    until(page, "/^\\d+ taken, next /.test(document.querySelector('#progress').textContent)")
    page.click("#interval-stop")
    until(page, "document.querySelector('#outcome').textContent === 'the interval is stopped'")
    until(page, "document.querySelector('#interval-stop').disabled")
    until(page, "!document.querySelector('#interval-go').disabled")
    assert watched.wrong == []


def test_pictures_leave_connections_to_the_shutter(chromium: Browser, daemon: Daemon) -> None:
    """A browser has six connections to a host: were pictures to take all of them, Stop would wait behind them."""
    watched = opened(chromium, daemon, LAPTOP)
    page = watched.page
    held: list[Route] = []
    let_go = False
    page.route("**/api/frames/**", lambda route: route.continue_() if let_go else held.append(route))
    indices = []
    for _ in range(3):
        until(page, "!document.querySelector('#shoot').disabled")
        page.evaluate("document.querySelector('#outcome').textContent = ''")
        page.click("#shoot")
        until(page, "document.querySelector('#outcome').textContent.startsWith('shot ')")
        indices.append(int(page.inner_text("#outcome").split()[1]))
        page.locator(f'#strip [data-frame="{indices[-1]}"] img').wait_for(state="attached")
    eventually(lambda: page.evaluate("true") and len(held) >= 3, "three pictures are asked for")
    assert len(held) == 3, "thumbnails, the map's pictures and the views together"
    let_go = True
    for one in held:
        one.continue_()
    for index in indices:
        until(page, f"document.querySelector('#strip [data-frame=\"{index}\"] img').naturalWidth > 0")
    assert watched.wrong == []


def test_photographs_by_distance_are_shown_and_stopped(chromium: Browser, tmp_path: Path, sockets: Path) -> None:
    """They begin by themselves: the page must tell that they do, and end them."""
    by_itself = "[trigger]\ndistance_m = 9\nfrom_height_m = 2\n"
    with simulated(tmp_path, sockets, settings=by_itself, simulate=True) as daemon:
        watched = opened(chromium, daemon, PHONE)
        page = watched.page
        until(page, "/^[1-9]\\d* taken, one each 9.0 m$/.test(document.querySelector('#progress').textContent)")
        assert page.is_disabled("#interval-go")
        page.screenshot(path=SCREENSHOTS / "series-phone.png")
        page.click("#interval-stop")
        until(page, "document.querySelector('#outcome').textContent === 'the interval is stopped'")
        until(page, "document.querySelector('#progress').textContent === ''")
        until(page, "!document.querySelector('#interval-go').disabled")
        assert watched.wrong == []


@pytest.mark.long
def test_a_phone_shows_go_or_no_go_first_and_fits(chromium: Browser, daemon: Daemon) -> None:
    watched = opened(chromium, daemon, PHONE, device_scale_factor=2, is_mobile=True, has_touch=True)
    page = watched.page
    shoot(page)
    page.wait_for_selector("#gl:not([hidden])")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / "phone.png")
    page.screenshot(path=SCREENSHOTS / "phone-whole.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    verdict, button = page.locator("#verdict").bounding_box(), page.locator("#shoot").bounding_box()
    assert verdict is not None
    assert button is not None
    assert verdict["y"] < 150
    assert button["y"] + button["height"] <= PHONE["height"]  # under the thumb without scrolling
    assert button["height"] >= 48
    assert watched.wrong == []


SIZES = [(390, 844), (844, 390), (1024, 600), (1280, 800)]


@pytest.mark.parametrize(
    ("width", "height"), [SIZES[0], *(pytest.param(*size, marks=pytest.mark.long) for size in SIZES[1:])]
)
def test_the_first_screen_has_verdict_shutter_instruments_and_picture(
    chromium: Browser, daemon: Daemon, width: int, height: int
) -> None:
    phone = min(width, height) < 500
    watched = opened(chromium, daemon, {"width": width, "height": height}, is_mobile=phone, has_touch=phone)
    page = watched.page
    frame = shoot(page)
    page.wait_for_selector("#gl:not([hidden])")
    until(page, f"document.querySelector('#which').textContent === 'frame {frame}'")
    until(page, "document.querySelector('#instruments .histogram svg') !== null")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"first-screen-{width}x{height}.png")
    assert page.evaluate("window.scrollY") == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    names = ("verdict", "shoot", "interval-stop", "instruments", "gl")
    boxes = {name: page.locator(f"#{name}").bounding_box() for name in names}
    floor = boxes["shoot"]["y"] if width < 700 and boxes["shoot"] else height  # the button lies over the page there
    for name, box in boxes.items():
        assert box is not None, name
        below = box["y"] + box["height"]
        assert (below <= height) if name in ("shoot", "interval-stop") else (below <= floor), (name, box)
    assert boxes["gl"] is not None
    assert boxes["interval-stop"] is not None
    assert boxes["interval-stop"]["height"] >= (64 if width < 700 else 56)
    assert boxes["gl"]["height"] >= 0.4 * min(width, height), "the picture is there to be looked at"
    until_text(
        page,
        "#instruments",
        r"^(?![\s\S]*unknown)",
        r"ISO\s*\d+",
        r"shutter\s*1/\d+ s",
        r"stop\s*f/[\d.]+",
        r"battery\s*\d+ ?%\s*(now|\d+ (s|min))",
        r"link\s*(\d of \d )?heard\s*now",
        r"photo\s*#\d+\s*(now|\d+ (s|min))",
        r"space\s*[\d.]+\sGB\s*now",
        r"GNSS\s*RTK fixed, \d+ sat",
        r"vehicle's battery\s*\d+ %, 2\d\.\d V",
        r"frames left\s*[1-9]",
        r"[\d.]+\s% clipped",
    )
    small = page.evaluate(
        """[...document.querySelectorAll('button, select, input:not([type=checkbox]), label.follow')]
            .filter((one) => one.offsetParent !== null)
            .map((one) => [one.id || one.textContent, one.getBoundingClientRect()])
            .filter(([, box]) => box.width < 44 || box.height < 44)
            .map(([name, box]) => `${name} ${box.width} ${box.height}`)"""
    )
    assert small == [], "a thumb misses these"
    forbidden = Finding(Code.USB_FORBIDDEN, Subject("usb"), {"body": "Canon EOS 450D", "node": "/dev/bus/usb/001/004"})
    before, after, cut = page.evaluate(
        """([long, why, todo]) => {
            const box = (name) => document.getElementById(name).getBoundingClientRect();
            const at = () => ['shoot', 'interval-stop'].map((name) => box(name).y);
            const before = at();
            const put = (name, text) => { document.getElementById(name).textContent = text; };
            put('verdict-text', why);
            put('verdict-todo', todo);
            const cut = box('verdict-todo').bottom - box('verdict').bottom;
            for (const name of ['verdict-text', 'outcome']) put(name, long);
            return [before, at(), cut];
        }""",
        [
            "decoding: 3 frames in a row can't be decoded: the carriers are nowhere near the calibration's; " * 3,
            str(text(forbidden)),
            str(remedy(forbidden)),
        ],
    )
    assert cut <= 0, "what to do is not cut off"
    page.screenshot(path=SCREENSHOTS / f"long-reason-{width}x{height}.png")
    assert after == before, "a reason of many words moves a button from under a finger"
    assert watched.wrong == []


@pytest.mark.long
@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
def test_the_map_shows_the_planned_area_and_what_of_it_was_not_seen(
    chromium: Browser, tmp_path: Path, sockets: Path, width: int, height: int
) -> None:
    metre = 1 / 111_319.49
    ring = [[-91.5417 + 1.34 * metre * x, 41.6361 + metre * y] for x, y in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    area = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    (tmp_path / "field.geojson").write_text(json.dumps(area))
    phone = width < 500
    with simulated(tmp_path, sockets, settings='area = "field.geojson"\n', simulate=True) as daemon:
        watched = opened(chromium, daemon, {"width": width, "height": height}, is_mobile=phone, has_touch=phone)
        page = watched.page
        until_text(page, "#instruments", r"area seen\s*0 % by 0 frames")
        frame = shoot(page)
        until(page, f"document.querySelector('#which').textContent === 'frame {frame}'")
        until(page, r"/[1-9][0-9.]* % by 1 frame/.test(document.querySelector('#instruments').innerText)")
        page.locator("#map").scroll_into_view_if_needed()
        page.wait_for_timeout(500)  # the picture of the holes
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=SCREENSHOTS / f"area-{width}x{height}.png")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert watched.wrong == []


@pytest.mark.long
def test_live_view_before_a_shot_and_off_while_shooting(chromium: Browser, tmp_path: Path, sockets: Path) -> None:
    with simulated(tmp_path, sockets) as daemon:
        for viewport in (
            PHONE,
            {"width": 844, "height": 390},
            {"width": 1024, "height": 600},
            {"width": 1280, "height": 800},
        ):
            watched = opened(chromium, daemon, viewport)
            page, caption = watched.page, "document.querySelector('#caption').textContent"
            page.click("#tab-live")
            page.wait_for_selector("#live:not([hidden])")
            until(page, f"/of the middle/.test({caption})")
            assert re.fullmatch(r"sharpness \d+ % of the best, [\d.]+ % clipped", page.inner_text("#which"))
            for name in ("#which", "#live"):  # what the ring is turned by and the histogram, on the first screen
                below = page.locator(name).bounding_box()
                assert below is not None
                assert below["y"] + below["height"] <= viewport["height"], name
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            page.screenshot(path=SCREENSHOTS / f"live-{viewport['width']}x{viewport['height']}.png")
            page.click("#live")
            until(page, f"/part that you see/.test({caption})")
            assert watched.wrong == []
        page.click("#shoot")
        until(page, "/off while shooting/.test(document.querySelector('#empty').textContent)")
        page.click("#tab-refocus")
        until(page, "document.querySelector('#live').hidden")
        assert watched.wrong == []


@pytest.mark.long
def test_a_setting_is_set_and_what_the_body_says_is_shown(chromium: Browser, daemon: Daemon) -> None:
    watched = opened(chromium, daemon, LAPTOP)
    page = watched.page
    page.wait_for_selector("#set-CAM_ISO:not([disabled])")
    before = page.input_value("#set-CAM_ISO")
    offered = page.evaluate("[...document.querySelector('#set-CAM_ISO').options].map((one) => one.value)")
    other = next(value for value in offered if value != before)
    for value in (other, before):
        page.select_option("#set-CAM_ISO", value)
        page.click("[data-set=CAM_ISO]")
        until(page, f"document.querySelector('#outcome').textContent === 'ISO is {value}'")
        until(page, f"/ISO\\s*{value}/.test(document.querySelector('#instruments').textContent)")
    assert page.locator("#set-CAM_BATTERY").is_hidden()  # it can only be read
    page.select_option("#set-LF_MASK", "mask-1")  # not sent before its button is pressed
    assert page.inner_text("[data-set=LF_MASK]") == "End the flight, set"
    assert watched.wrong == []


def test_what_a_camera_that_is_away_said_last_is_grey_with_its_age(chromium: Browser, daemon: Daemon) -> None:
    page = opened(chromium, daemon, PHONE, is_mobile=True, has_touch=True).page
    with client(daemon) as one:
        state = one.get("/api/state").raise_for_status().json()
    battery = "[...document.querySelectorAll('#instruments div')].find((one) => one.innerText.startsWith('battery'))"
    until(page, f"{battery}?.dataset.old === undefined && Boolean({battery})")
    absent = {"code": "camera.absent", "state": "no-go", "text": "the camera is absent", "todo": "connect it"}
    state["health"]["camera"] = {"state": "absent", "reason": ""}
    state["findings"], state["verdict"] = [{**absent, "age_s": 130.0}], "no-go"
    told = f"retry: 500\ndata: {json.dumps(state)}\n\n"
    page.route("**/api/events", lambda route: route.fulfill(body=told, content_type="text/event-stream"))
    page.reload()
    until(page, "document.querySelector('#verdict').dataset.state === 'no-go'")
    assert page.inner_text("#verdict-text") == "the camera is absent"
    assert page.inner_text("#verdict-todo") == "connect it"
    assert page.inner_text("#verdict-age") == "camera.absent, for 2 min"
    page.screenshot(path=SCREENSHOTS / "camera-away-phone.png")
    for name in ("ISO", "battery"):
        cell = battery.replace("battery", name)
        assert page.evaluate(f"'old' in {cell}.dataset"), name
        assert re.search(r"2 min$", page.evaluate(f"{cell}.innerText")), name


@pytest.mark.long
def test_without_webgl_the_vehicle_makes_the_picture(daemon: Daemon, chromium: Browser) -> None:
    without = "HTMLCanvasElement.prototype.getContext = (of => function (kind, ...more) {"
    without += (
        "return kind === 'webgl2' ? null : of.call(this, kind, ...more); })(HTMLCanvasElement.prototype.getContext)"
    )
    context = chromium.new_context(viewport=LAPTOP)
    context.add_init_script(without)
    page = context.new_page()
    page.set_default_timeout(DEADLINE_MS)
    page.goto(f"{daemon.url}#token={TOKEN}")
    until_flown(page)
    frame = shoot(page)
    page.wait_for_selector('#picture[data-kind="refocus"]:not([hidden])')
    assert "no WebGL2" in page.inner_text("#caption")
    before = page.evaluate("document.querySelector('#picture').src")
    page.locator("#disparity").fill("2")
    until(page, f"document.querySelector('#picture').src !== '{before}'")
    views = mosaic(daemon, frame)
    ours = pictures.refocused(views, 2.0).astype(np.float64)
    with client(daemon) as one:
        made = grey(one.get(f"/api/frames/{frame}/refocus.jpg?disparity=2").raise_for_status().content)
    assert np.abs(made - ours).mean() < 4.0  # both through a JPEG of their own
    page.screenshot(path=SCREENSHOTS / "laptop-without-webgl.png")


def test_the_token_is_asked_for(chromium: Browser, daemon: Daemon) -> None:
    watched = opened(chromium, daemon, LAPTOP, log_in=False)
    page = watched.page
    page.wait_for_selector("#login[open]")
    page.fill("#token", "a guess")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#login-text').textContent === 'this is not the token'")
    page.screenshot(path=SCREENSHOTS / "laptop-token.png")
    page.fill("#token", TOKEN)
    page.keyboard.press("Enter")
    until_flown(page)
    assert TOKEN not in page.url
    assert all(re.search(r"status of 40[13]\b", text) for text in watched.wrong), (
        watched.wrong
    )  # the browser's own notes of 401 and 403
