"""Fixtures that every room may use."""

from __future__ import annotations

import functools
import gc
import os
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does; before NumPy is loaded

import pytest
from hypothesis import HealthCheck, settings

from tests import forked, left_behind, shared

# No test fails for the speed of the machine it runs on, nor by chance: by default the examples are the same each time.
settings.register_profile("many", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=300)
settings.register_profile("dappled", settings.get_profile("many"), max_examples=25, derandomize=True)
settings.load_profile("dappled")


SLOW_S = 600.0


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Modules and tests stay to the end: garbage is not looked for among them, which costs a tenth of all; and what a
    test makes is looked through less often than Python would, which costs a twentieth."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


@functools.cache
def _marks_in(path: Path) -> set[str]:
    return set(re.findall(r"mark\.(\w+)", path.read_text(encoding="utf-8")))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A long test is a slow one too. A slow test that names no limit of its own has a long one: a busy machine takes
    twice as long. Its mark stands in its file: the Makefile has others not even read."""
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.slow)
        for mark, names in (("slow", {"slow", "long"}), ("alone", {"alone"})):
            if item.get_closest_marker(mark) and not names & _marks_in(item.path):
                raise pytest.UsageError(f"{item.nodeid} is {mark}, and its file doesn't say so")
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_S))


_watch = left_behind.Watch()
_forks = forked.Forks()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Default tests fork their processes of dappled, with all that their fixtures start (`tests/forked.py`)."""
    slow = item.get_closest_marker("slow") is not None
    _forks.on = sys.platform == "linux" and not slow and "coverage" not in sys.modules
    if _forks.on and not _forks.begun:
        with _watch.wider():
            _forks.begin()


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
    """What a fixture of a wider scope makes may outlive the test that asked for it first."""
    if fixturedef.scope == "function":
        return (yield)
    with _watch.wider():
        return (yield)


# Where this was seen to hold: a room is added once its tests end what they begin.
TIDY = tuple(
    f"tests/{room}"
    for room in (
        "bounds",
        "config",
        "daemon/camera_protocol",
        "daemon/health",
        "daemon/navigation",
        "daemon/pipeline",
        "daemon/replay",
        "daemon/stream",
        "daemon/test_",
        "drivers/gnss",
        "drivers/test_",
        "drivers/wired",
        "flight",
        "mocks",
        "test_",
    )
)


@pytest.fixture(autouse=True)
def nothing_left_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    """A test ends its threads and child processes and closes its sockets."""
    if not request.node.nodeid.startswith(TIDY) or not Path("/proc/self/fd").is_dir():  # there is none on macOS
        yield
        return
    before = left_behind.held()
    yield
    if left := _watch.left(before):
        pytest.fail(f"left behind: {left_behind.named(left)}")


@pytest.fixture
def tmp_path(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A test that asks which disk a folder is on has one on a disk (tools/in_memory.py)."""
    memory = Path("/dev/shm")
    asks = request.node.get_closest_marker("disk") and memory.is_dir()
    if not asks or memory.stat().st_dev != tmp_path.stat().st_dev:
        yield tmp_path
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real frames and flights beside the project (or DAPPLED_DATA); skips where there is none."""
    folder = Path(os.environ.get("DAPPLED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder} (set DAPPLED_DATA)")
    return folder


@pytest.fixture
def types_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What mypy keeps of the modules that programs of users import: one program after another."""
    with shared.alone(shared.folder_of_run(tmp_path_factory), "mypy") as folder:
        yield folder


def pytest_configure() -> None:
    """Processes may be forked from here on, and have their sockets where no other process of tests, nor a daemon, has
    its own: a user's daemon holds the camera."""
    os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="dpl-")
    _forks.install()


def pytest_unconfigure(config: pytest.Config) -> None:
    """End the process although a test that failed has left a thread behind: the interpreter would wait for it for ever,
    and so would whoever waits for the tests."""
    _forks.close()
    shutil.rmtree(os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)
    left = [one.name for one in threading.enumerate() if one is not threading.main_thread() and not one.daemon]
    if left and not hasattr(config, "workerinput"):
        print(f"left behind by tests: the threads {', '.join(left)}", file=sys.stderr, flush=True)  # noqa: T201
        sys.stdout.flush()
        os._exit(_ended.get("status", 1) or 1)


_ended: dict[str, int] = {}


def pytest_sessionfinish(exitstatus: int) -> None:
    """Keep how the tests ended, for `pytest_unconfigure`."""
    _ended["status"] = int(exitstatus)
