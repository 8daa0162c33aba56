"""The console in a real browser, in front of a whole simulated daemon: how tests begin it, and wait for its page."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page  # not in the smaller environment

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
SCREENSHOTS = Path(__file__).parents[2] / "build" / "screenshots"
TOKEN = "only-for-this-test-0123456789"  # noqa: S105  # it opens nothing
DEADLINE_MS = 90_000
LAPTOP, PHONE = {"width": 1440, "height": 900}, {"width": 390, "height": 844}
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@dataclass
class Daemon:
    """A simulated daemon with a console."""

    url: str
    flights: Path
    process: subprocess.Popen[str]
    said: list[str] = field(default_factory=list)


@contextmanager
def simulated(
    folder: Path, sockets: Path, *, settings: str = "", simulate: bool | None = None, code: int = 0
) -> Iterator[Daemon]:
    """`dappled run` with a console that asks for a token, on a port that the system chose; `--simulate`, unless more
    `settings` are given, or as `simulate` says. A process that the test has not killed must end in order, with this
    code and no traceback."""
    (folder / "token").write_text(TOKEN)
    (folder / "token").chmod(0o600)
    (folder / "dappled.toml").write_text(
        f'[record]\ndirectory = "flights"\n[publish]\nslices = "ipc://{sockets}/{folder.name}"\n'
        f'[console]\nbind = "127.0.0.1:0"\ntoken = "token"\n{settings}'
    )
    words = ("--simulate", "--seed", "3") if (not settings if simulate is None else simulate) else ()
    process = subprocess.Popen(
        [sys.executable, "-m", "dappled", "run", *words, "--config", "dappled.toml"],
        cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    said: list[str] = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("console "):
            break
    if process.poll() is not None:
        process.stderr.close()
        pytest.fail("".join(said))
    url = said[-1].split()[1]  # before others follow it
    reader = threading.Thread(target=said.extend, args=[process.stderr])
    reader.start()
    try:
        yield Daemon(url, folder / "flights", process, said)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) in (code, -signal.SIGKILL), "".join(said)
    finally:
        process.kill()
        reader.join(60)
        process.stderr.close()
    assert not any("Traceback" in line for line in said), "".join(said)


@dataclass
class Watched:
    """A page, and what it did that it should not."""

    page: Page
    wrong: list[str]


def opened(browser: Browser, daemon: Daemon, viewport: dict[str, Any], *, log_in: bool = True, **more: Any) -> Watched:
    """The console in a browser profile of its own, until it has judged go or no-go."""
    context = browser.new_context(viewport=viewport, **more)
    page = context.new_page()
    wrong: list[str] = []
    # A browser logs every refusal as an error: a 409 is an answer in words, which the page shows.
    page.on(
        "console",
        lambda m: (
            wrong.append(f"{m.type}: {m.text}")
            if m.type in ("error", "warning") and "409 (Conflict)" not in m.text
            else None
        ),
    )
    page.on("pageerror", lambda error: wrong.append(f"page error: {error}"))
    page.on("request", lambda r: None if r.url.startswith((daemon.url, "blob:", "data:")) else wrong.append(r.url))
    page.set_default_timeout(DEADLINE_MS)
    if log_in:
        page.goto(f"{daemon.url}#token={TOKEN}")
        until_flown(page)
    else:
        page.goto(daemon.url)
    return Watched(page, wrong)


def until_flown(page: Page) -> None:
    """Until the page says go, with caution perhaps; what it said instead, if not."""
    until(page, "['go', 'caution'].includes(document.querySelector('#verdict').dataset.state)")


def until(page: Page, condition: str) -> None:
    """Wait for a JavaScript condition. (Playwright's own way needs eval, which the page's rules forbid.)"""
    deadline = time.monotonic() + DEADLINE_MS / 1e3
    while not page.evaluate(condition):
        said = (
            f"{page.inner_text('#verdict')!r}, {page.inner_text('#outcome')!r}" if time.monotonic() > deadline else ""
        )
        assert not said, f"never: {condition}; the page says {said}"
        page.wait_for_timeout(30)


def until_text(page: Page, part: str, *patterns: str) -> str:
    """Wait until the text of a part of the page has all these patterns; the text."""
    deadline = time.monotonic() + DEADLINE_MS / 1e3
    while missing := [one for one in patterns if not re.search(one, page.inner_text(part))]:
        assert time.monotonic() < deadline, (missing, page.inner_text(part))
        page.wait_for_timeout(30)
    return str(page.inner_text(part))


def shoot(page: Page) -> int:
    """Press the button as a keyboard would; the frame's number once its views are drawn."""
    deadline = time.monotonic() + DEADLINE_MS / 1e3
    page.focus("#shoot")
    while not (told := page.inner_text("#outcome")).startswith("shot "):
        # What others asked for may still be under way: then it is refused in words, and a person presses again.
        assert time.monotonic() < deadline, told
        until(page, "!document.querySelector('#shoot').disabled")
        page.focus("#shoot")
        page.evaluate("document.querySelector('#outcome').textContent = ''")
        page.keyboard.press("Enter")
        until(page, "!['', 'sending…'].includes(document.querySelector('#outcome').textContent)")
    index = int(told.split()[1])
    page.wait_for_selector(f'#strip [data-frame="{index}"][aria-selected="true"] img')
    until(page, f"document.querySelector('#which').textContent === 'frame {index}'")
    until(page, "!document.querySelector('#gl').hidden || !document.querySelector('#picture').hidden")
    return index


def client(daemon: Daemon) -> httpx.Client:
    """Another client with the token."""
    return httpx.Client(base_url=daemon.url, headers={"authorization": f"Bearer {TOKEN}"}, timeout=30)
