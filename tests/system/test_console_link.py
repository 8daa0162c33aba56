"""The console over a link that is cut, and at a daemon's end: nothing is fired late, and nothing old looks new."""

from __future__ import annotations

import contextlib
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from dappled.findings import Code
from tests.daemon.test_settings_check import calibration
from tests.system.browsing import (
    DEADLINE_MS,
    SCREENSHOTS,
    TOKEN,
    Daemon,
    client,
    shoot,
    simulated,
    until,
    until_flown,
    until_text,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

SIZES = {"phone": (390, 844), "phone-on-its-side": (844, 390), "tablet": (1024, 600), "laptop": (1280, 800)}

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.alone, pytest.mark.usefixtures("leave")]


class Link:
    """A TCP link to the console that can be cut: what is on its way then is held, and comes when it is mended."""

    def __init__(self, daemon: Daemon) -> None:
        self._to = ("127.0.0.1", int(daemon.url.rstrip("/").rpartition(":")[2]))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/"
        self._whole = threading.Event()
        self._whole.set()
        self._ended = False
        self._sockets: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._whole.clear()

    def mend(self) -> None:
        self._whole.set()

    def close(self) -> None:
        self._ended = True
        self._whole.set()
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while not self._ended:
                near = self._listener.accept()[0]
                far = socket.create_connection(self._to)
                self._sockets += [near, far]
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=pair, daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                target.sendall(data)
        self._whole.wait()
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_WR)


@pytest.fixture
def link(daemon: Daemon) -> Iterator[Link]:
    one = Link(daemon)
    yield one
    one.close()


# What a page's outcome ever said, and a clock that stands while a test says so: nothing gets old on a busy machine.
WATCHED = """
    const now = performance.now.bind(performance), ever = [];
    let at = null;
    performance.now = () => at ?? now();
    window.stands = (yes) => { at = yes ? now() : null; };
    window.everSaid = (words) => ever.some((one) => one.includes(words));
    addEventListener("DOMContentLoaded", () => {
        const outcome = document.querySelector("#outcome");
        new MutationObserver(() => ever.push(outcome.textContent)).observe(outcome, { childList: true, subtree: true });
    });
"""


def page_of(browser: Browser, url: str, size: str, state: str = "") -> Page:
    """The page at a size, once it says go (with caution perhaps), or `state`."""
    width, height = SIZES[size]
    touch = {"is_mobile": True, "has_touch": True} if "phone" in size else {}
    context = browser.new_context(viewport={"width": width, "height": height}, **touch)
    context.add_init_script(WATCHED)
    page = context.new_page()
    page.set_default_timeout(DEADLINE_MS)
    page.goto(f"{url}#token={TOKEN}")
    if state:
        until(page, f"document.querySelector('#verdict').dataset.state === {state!r}")
    else:
        until_flown(page)
    return page


def picture(page: Page, size: str, what: str) -> None:
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"{size}-{what}.png")


def requested(daemon: Daemon) -> int:
    with client(daemon) as one:
        return int(one.get("/api/state").raise_for_status().json()["health"]["shots"]["wished"])


def ticks(page: Page) -> int:
    return int(page.locator('#checks svg:not([aria-label="unknown"])').count())


def is_old(page: Page) -> bool:
    """All that the page shows is grey, as what was last heard."""
    return bool(page.evaluate("document.body.hasAttribute('data-stale')"))


def until_new(page: Page) -> None:
    """Until what the page shows is what is heard now."""
    until(page, "!document.body.hasAttribute('data-stale')")


def top_of_page(page: Page) -> float:
    """Where the page begins below its header, in px."""
    return float(page.evaluate("document.querySelector('main').getBoundingClientRect().top"))


def said_now(page: Page) -> str:
    return str(page.inner_text("#outcome"))


def said(what: str) -> str:
    return f"document.querySelector('#outcome').textContent.includes({what!r})"


@pytest.mark.parametrize(
    "size", ["phone", *(pytest.param(size, marks=pytest.mark.long) for size in SIZES if size != "phone")]
)
def test_over_a_cut_link_nothing_is_fired_late_and_nothing_old_looks_new(
    chromium: Browser, daemon: Daemon, link: Link, size: str
) -> None:
    page = page_of(chromium, link.url, size)
    before, stood = requested(daemon), top_of_page(page)
    page.evaluate("stands(true)")  # a button of a page that hears nothing can't be pressed
    until_new(page)
    link.cut()
    page.click("#shoot")
    until(page, "everSaid('sending…')")
    picture(page, size, "sending")
    page.evaluate("stands(false)")
    until(page, said("not confirmed; it may have fired"))
    until(page, "document.querySelector('#verdict').dataset.state === 'lost'")
    assert page.inner_text("#verdict-word") == "No contact"
    ground = "getComputedStyle(document.querySelector('#verdict')).backgroundColor"
    assert page.evaluate(ground) == "rgb(179, 19, 14)", "no green, not even as it fades, under these words"
    assert is_old(page)
    assert ticks(page) == 0
    assert page.is_disabled("#shoot")
    assert top_of_page(page) == stood, "what is under a thumb must not move as contact is lost"
    picture(page, size, "cut")
    link.mend()
    until_flown(page)
    until(page, said("nothing was fired"))
    assert requested(daemon) == before
    until_new(page)
    if size == "phone":
        shoot(page)
        until(page, f"Number(document.querySelector('#counters dd').textContent) === {before + 1}")


@pytest.mark.parametrize("size", ["phone", pytest.param("laptop", marks=pytest.mark.long)])
def test_a_running_series_is_on_the_first_screen_and_stopped_over_a_bad_link(
    chromium: Browser, daemon: Daemon, link: Link, size: str
) -> None:
    page = page_of(chromium, link.url, size)
    _, height = SIZES[size]
    begin_series(page)
    until(page, r"/^\d+ taken, next /.test(document.querySelector('#progress').textContent)")
    page.evaluate("scrollTo(0, 0)")
    picture(page, size, "series")
    for name in ("progress", "interval-stop"):
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        assert 0 <= box["y"] < box["y"] + box["height"] <= height, name
    link.cut()
    page.click("#interval-stop")
    until(page, said("not confirmed; it may still be shooting"))
    assert page.inner_text("#interval-stop") == "Stopping…"
    picture(page, size, "stopping")
    link.mend()
    until(page, said("the interval is stopped"))
    until_flown(page)
    until(page, "document.querySelector('#progress').textContent === ''")
    until(page, "document.querySelector('#interval-stop').textContent === 'Stop'")
    picture(page, size, "stopped")
    assert said_now(page) == "the interval is stopped"
    another = page_of(chromium, daemon.url, "laptop")
    begin_series(another)  # what was said of the last one is over
    until(page, "document.querySelector('#outcome').textContent === ''")
    until(page, "!document.querySelector('#interval-stop').disabled")
    page.click("#interval-stop")
    until(page, said("the interval is stopped"))


def test_stop_repeated_across_a_restart_says_that_the_daemon_was_started_again(
    chromium: Browser, daemon: Daemon
) -> None:
    page = page_of(chromium, daemon.url, "phone")
    begin_series(page)
    earlier = "another-1"  # the token of a start before this one, which page and answer were lost with
    page.evaluate("(token) => sessionStorage.setItem('stop', JSON.stringify({ token, elapsed_ms: 1e9 }))", earlier)
    lost: list[Route] = []

    def loses_the_first(route: Route) -> None:
        if lost:
            route.continue_()
        else:
            lost.append(route)
            route.abort()

    page.route("**/api/interval/stop", loses_the_first)
    page.reload()
    until(page, said("no interval of then is running: the daemon was started again since"))
    assert lost
    until(page, r"/^\d+ taken, next /.test(document.querySelector('#progress').textContent)")  # what runs now is shown
    page.click("#interval-stop")
    until(page, said("the interval is stopped"))


def begin_series(page: Page) -> None:
    """Press Start for a series without an end, until one is begun."""
    page.fill("#interval-s", "0.5")
    page.fill("#interval-count", "0")
    for _ in range(100):
        until(page, "!document.querySelector('#interval-go').disabled")
        page.evaluate("document.querySelector('#outcome').textContent = ''")
        page.click("#interval-go")
        until(page, "!['', 'sending…'].includes(document.querySelector('#outcome').textContent)")
        if said_now(page).startswith("shot "):
            break
        page.wait_for_timeout(100)  # refused: what others asked for is under way
    until(page, "!document.querySelector('#interval-stop').disabled")


@pytest.mark.long
def test_an_answer_that_was_lost_is_asked_for_by_number(chromium: Browser, daemon: Daemon, link: Link) -> None:
    page = page_of(chromium, link.url, "laptop")
    before = requested(daemon)
    page.route("**/api/shoot", lambda route: (route.fetch(), route.abort()))  # it arrives; the answer does not
    page.click("#shoot")
    until(page, said("shot "))
    assert "not confirmed" not in page.inner_text("#outcome")
    until(page, f"Number(document.querySelector('#counters dd').textContent) === {before + 1}")


@pytest.mark.long
@pytest.mark.parametrize("size", SIZES)
def test_what_a_thumb_needs_is_on_the_first_screen(chromium: Browser, daemon: Daemon, size: str) -> None:
    page = page_of(chromium, daemon.url, size)
    if requested(daemon) == 0:
        shoot(page)
    until(page, "document.querySelector('#which').textContent.startsWith('frame ')")
    width, height = SIZES[size]
    picture(page, size, "flown")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for name in ("verdict", "shoot", *(() if size == "phone" else ("panel",))):
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        assert box["y"] >= 0, name
        assert box["y"] + box["height"] <= height, name
    if width >= 700:
        stage, button = page.locator(".stage").bounding_box(), page.locator("#shoot").bounding_box()
        assert stage is not None
        assert button is not None
        assert stage["x"] >= button["x"] + button["width"]  # side by side
    small = page.evaluate(
        """[...document.querySelectorAll('button, input:not([type=checkbox]), label.follow')]
           .filter(one => one.offsetParent)
           .map(one => [one.id || one.textContent, one.getBoundingClientRect()])
           .filter(([, box]) => box.width < 44 || box.height < 44).map(([name]) => name)"""
    )
    assert small == []


@pytest.mark.parametrize(
    ("number", "word"), [pytest.param(signal.SIGTERM, "Ended", marks=pytest.mark.long), (signal.SIGKILL, "No contact")]
)
def test_a_flight_s_end_is_told_and_a_death_is_no_end(
    chromium: Browser, tmp_path: Path, sockets: Path, number: int, word: str
) -> None:
    with simulated(tmp_path, sockets) as one:
        page = page_of(chromium, one.url, "phone")
        told = until_text(page, "#instruments", r"frames left\s*unknown", r"histogram\s*unknown")
        assert not re.search(r"(?<![.\d])0(?![.\d])", told), "before the first frame what is not known is no number"
        shoot(page)
        one.process.send_signal(number)
        until(page, f"document.querySelector('#verdict-word').textContent === {word!r}")
        one.process.wait(60)
        page.wait_for_timeout(4000)  # it stays so when nothing is heard any more
        assert page.inner_text("#verdict-word") == word
        assert ticks(page) == 0
        assert page.is_disabled("#shoot")
        if word == "Ended":
            assert page.inner_text("#verdict-text") == "1 shot: 1 frame recorded"
        at_all_sizes(page, word.lower().replace(" ", "-"))
        if word == "Ended":
            recorded_flight(chromium, one.flights)


def recorded_flight(browser: Browser, flights: Path) -> None:
    """What was recorded, on the same page: its frame at every size, and nothing that looks as if it could be fired."""
    (flight,) = (path for path in flights.iterdir() if path.is_dir())
    words = [sys.executable, "-m", "dappled", "open", str(flight), "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as command:
        try:
            assert command.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:\d+/", command.stdout.readline())
            assert found
            page = browser.new_context(viewport={"width": 390, "height": 844}).new_page()
            page.goto(found[0])
            until(page, "document.querySelector('#which').textContent === 'frame 0'")
            until(page, "!document.querySelector('#gl').hidden")
            assert not page.is_visible("#shoot") or page.is_disabled("#shoot")
            for size, (width, height) in SIZES.items():
                page.set_viewport_size({"width": width, "height": height})
                assert page.evaluate("document.documentElement.scrollWidth") <= width
                box = page.locator("#gl").bounding_box()
                assert box is not None
                assert box["y"] + box["height"] <= height, (size, box)
                picture(page, size, "recorded")
        finally:
            command.send_signal(signal.SIGINT)


# Nothing is wrong that a flight could not do without: no mask, no autopilot, a body that tells nothing of itself.
BARE = '[camera]\ndriver = "simulated"\noptions = {picture = "pattern:60000:dng"}\n'


@pytest.mark.long
def test_what_is_lost_without_mask_and_link_is_a_caution_with_names(
    chromium: Browser, tmp_path: Path, sockets: Path
) -> None:
    with simulated(tmp_path, sockets, settings=BARE) as one:
        page = page_of(chromium, one.url, "phone", "caution")
        assert page.inner_text("#verdict-word") == "Caution"
        assert state_of(page, Code.DECODE_NO_MASK) == "caution"
        assert page.inner_text("#verdict-text")
        at_all_sizes(page, "caution")


# What a camera that says who it is only when it is connected may turn out to be: frames of another size than those
# that the calibration is for, and files that are no pictures.
UNDECODABLE = """[camera]
driver = "simulated"
options = {picture = "pattern:60000:dng"}
[mask]
profile = "reference-5x5"
[decode]
calibration = "c.toml"
"""


@pytest.mark.long
def test_a_calibration_of_another_camera_is_no_go_on_the_page_before_and_after_frames(
    chromium: Browser, tmp_path: Path, sockets: Path
) -> None:
    calibration(tmp_path / "c.toml", "canon-eos-450d", "reference-5x5", "geometric")
    with simulated(tmp_path, sockets, settings=UNDECODABLE) as one:
        page = page_of(chromium, one.url, "phone", "no-go")
        assert state_of(page, Code.DECODE_MISFIT) == "no-go"
        at_all_sizes(page, "no-go")
        page.set_viewport_size({"width": 390, "height": 844})
        for index in range(3):
            page.click("#shoot")
            until(page, said(f"shot {index}"))  # a no-go refuses none
            until(page, f"document.querySelectorAll('#counters dd')[1].textContent === '{index + 1}'")
        assert state_of(page, Code.DECODE_MISFIT) == "no-go"
        at_all_sizes(page, "not-decoded")


def at_all_sizes(page: Page, what: str) -> None:
    """Pictures of a page in a lasting state; at every size verdict and shutter stand on the first screen."""
    for size, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        for name in ("verdict", "shoot"):
            box = page.locator(f"#{name}").bounding_box()
            assert box is not None
            assert 0 <= box["y"] < box["y"] + box["height"] <= height, (size, name, box)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        picture(page, size, what)


def state_of(page: Page, code: Code) -> str | None:
    """The state of a finding on the page."""
    state: str | None = page.locator(f'#checks [data-code="{code.value}"]').get_attribute("data-state")
    return state
