"""One flight, recorded as a user would record it: the daemon and a subscriber in processes of their own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests import shared
from tests.needs import without
from tests.system.browsing import CHROMIUM, FLAGS, Daemon, simulated
from tests.waiting import eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser  # not in the smaller environment

FRAMES = 2


@dataclass(frozen=True)
class Flown:
    """What a simulated run left behind."""

    flight: Path
    received: Path
    out: str
    err: str
    watched: str


def dappled(*arguments: str, cwd: Path | None = None, timeout_s: float = 240) -> subprocess.CompletedProcess[str]:
    """The `dappled` command in a process of its own."""
    command = [sys.executable, "-m", "dappled", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout_s, check=False)


def tells_of_no_problem(out: str, err: str, frames: int) -> None:
    """Every line on a person's screen is one of these: no warning of a library, no death of a process, no "problem"."""
    assert re.fullmatch(rf"(00000[0-{frames - 1}]  IMAGE_START_CAPTURE [^\n]* carriers [^\n]*\n){{{frames}}}", out)
    head = ("simulating ", "flight ", "stream ", "console ", "camera ready", "waiting for ")
    *told, last = err.splitlines()
    assert [line for line in told if not line.startswith(head)] == []
    assert last == f"{frames} shots: {frames} frames safe, {frames} decoded, 0 with a problem"
    assert not re.search("problem|PROBLEM|died|Warning|Traceback", out + "\n".join(told))


def until_it_listens(process: subprocess.Popen[Any]) -> None:
    """Until a subscriber in a process of its own has begun to connect: ZeroMQ has a thread for that. What is started
    after it can't be earlier, however busy the machine is."""

    def connects() -> bool:
        names = Path(f"/proc/{process.pid}/task").glob("*/comm")
        return process.poll() is not None or any(name.read_text() == "ZMQbg/IO/0\n" for name in names)

    eventually(connects, "the subscriber connects")


@pytest.fixture(scope="session")
def sockets() -> Iterator[Path]:
    """A folder with a short name, for ipc sockets."""
    with tempfile.TemporaryDirectory(prefix="dpl-") as folder:
        yield Path(folder)


@pytest.fixture(scope="package")
def daemon(tmp_path_factory: pytest.TempPathFactory, sockets: Path) -> Iterator[Daemon]:
    """One simulated daemon with a console, for all tests that leave it as it was."""
    with simulated(tmp_path_factory.mktemp("console"), sockets) as one:
        yield one


@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    """Debian's Chromium without a window; skips where there is none."""
    if shutil.which(CHROMIUM) is None:
        without(f"no browser at {CHROMIUM}: apt install chromium, or set CHROMIUM")
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  not in the smaller environment

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def leave(chromium: Browser) -> Iterator[None]:
    """A test's pages go with it, as a person closes them; each holds connections to the console."""
    yield
    for context in chromium.contexts:
        context.close()


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory, sockets: Path) -> Flown:
    """Two frames through the whole street, with `dappled watch` as the subscriber. Not to be written to."""
    folder = shared.folder_of_run(tmp_path_factory)
    return shared.once(folder, "flown", lambda: _fly(folder / "flown", sockets))


def _fly(folder: Path, sockets: Path) -> Flown:
    folder.mkdir()
    endpoint = f"ipc://{sockets}/flown"
    (folder / "dappled.toml").write_text(f'[record]\ndirectory = "flights"\n[publish]\nslices = "{endpoint}"\n')
    watch = subprocess.Popen(
        [sys.executable, "-m", "dappled", "watch", endpoint, "--save", str(folder / "received"),
         "--count", str(FRAMES), "--timeout", "240"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        until_it_listens(watch)
        run = dappled(
            "run", "--simulate", "--seed", "5", "--frames", str(FRAMES), "--config", "dappled.toml", cwd=folder
        )
        watched, _ = watch.communicate(timeout=240)
    finally:
        watch.kill()
    assert run.returncode == 0, run.stderr
    assert watch.returncode == 0, watched
    (flight,) = (entry for entry in (folder / "flights").iterdir() if entry.is_dir())
    return Flown(flight, folder / "received", run.stdout, run.stderr, watched)


@pytest.fixture
def copied(flown: Flown, tmp_path: Path) -> Path:
    """The flight, to be spoilt."""
    target = tmp_path / flown.flight.name
    shutil.copytree(flown.flight, target)
    return target


def flip(path: Path, place: int) -> None:
    """Turn one bit of a file."""
    with path.open("r+b") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 1]))
        os.fsync(file.fileno())
