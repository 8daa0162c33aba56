"""Pictures of the console, for docs/console.md: python tools/console_pictures.py docs/pictures

Runs a simulated daemon, takes six frames from the console's page in Chromium, and writes console.jpg,
console-spectrum.jpg and console-phone.jpg. Look at them before you commit them. CHROMIUM names another browser.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, ImageStat
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
GPU = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES, BETWEEN_MS, DEADLINE_S = 6, 1500, 180
QUALITY = 85


@contextmanager
def console() -> Iterator[str]:
    """The address of the console of a simulated daemon."""
    with tempfile.TemporaryDirectory() as place:
        settings = Path(place) / "dappled.toml"
        settings.write_text(
            f'[record]\ndirectory = "{place}/flights"\n[publish]\nslices = "ipc://{place}/slices"\n'
            '[console]\nbind = "127.0.0.1:0"\n'
        )
        command = [sys.executable, "-P", "-m", "dappled", "run", "--simulate", "--seed", "3", "--config", str(settings)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        try:
            assert process.stderr is not None
            yield next(line.split()[1] for line in process.stderr if line.startswith("console "))
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


def until(page: Page, condition: str) -> None:
    """Wait until a JavaScript condition holds. Raises TimeoutError."""
    deadline = time.monotonic() + DEADLINE_S
    while not page.evaluate(condition):
        if time.monotonic() > deadline:
            raise TimeoutError(condition)
        page.wait_for_timeout(50)


def shown(browser: Browser, url: str, width: int, height: int) -> Page:
    """The console in a window of this size, when it has judged that all is go."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(DEADLINE_S * 1000)
    page.goto(url)
    until(page, "document.querySelector('#verdict').dataset.state === 'go'")
    return page


def shoot(page: Page) -> int:
    """Press the button until a shot is taken, and wait until its picture is shown. Returns the frame's number."""
    page.wait_for_timeout(BETWEEN_MS)  # the vehicle flies on, so that the frames lie apart on the map
    while True:
        page.evaluate("document.querySelector('#outcome').textContent = ''")
        page.click("#shoot")
        until(page, "document.querySelector('#outcome').textContent !== ''")
        outcome = page.inner_text("#outcome")
        if outcome.startswith("shot "):
            break
        page.wait_for_timeout(BETWEEN_MS)  # refused: the camera is busy
    frame = int(outcome.split()[1])
    page.wait_for_selector(f'#strip [data-frame="{frame}"] img')
    until(page, f"document.querySelector('#which').textContent === 'frame {frame}'")
    return frame


def contrast(page: Page, frame: int) -> float:
    """How much a frame shows besides grass: the standard deviation of its thumbnail, averaged to 8 × 6 cells."""
    data = page.request.get(f"{page.url}api/frames/{frame}/thumb.jpg").body()
    with Image.open(io.BytesIO(data)) as picture:
        return ImageStat.Stat(picture.convert("L").resize((8, 6), Image.Resampling.BOX)).stddev[0]


def main(folder: Path) -> None:
    with console() as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GPU)
        laptop = shown(browser, url, 1440, 900)
        taken = [shoot(laptop) for _ in range(FRAMES)]
        best = max(taken, key=lambda frame: contrast(laptop, frame))
        laptop.click(f'#strip [data-frame="{best}"]')
        until(laptop, f"document.querySelector('#which').textContent === 'frame {best}'")
        laptop.wait_for_selector("#gl:not([hidden])")
        laptop.click("#autofocus")
        laptop.screenshot(path=folder / "console.jpg", type="jpeg", quality=QUALITY)
        laptop.click("#tab-spectrum")
        laptop.wait_for_selector('#picture[data-kind="spectrum"]:not([hidden])')
        laptop.screenshot(path=folder / "console-spectrum.jpg", type="jpeg", quality=QUALITY)
        phone = shown(browser, url, 390, 844)
        phone.click(f'#strip [data-frame="{best}"]')
        phone.evaluate("scrollTo(0, 0)")
        until(phone, f"document.querySelector('#which').textContent === 'frame {best}'")
        phone.wait_for_selector("#gl:not([hidden])")
        phone.screenshot(path=folder / "console-phone.jpg", type="jpeg", quality=QUALITY)
        browser.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
