"""A main loop that stands still is fed while the disk does not answer, and only then."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from dappled.daemon.health.patience import Patience
from dappled.daemon.health.systemd import Notifier

S = 1_000_000_000


class World:
    """A service manager that listens, and a process of three threads."""

    def __init__(self, folder: Path, manager: socket.socket) -> None:
        manager.bind(str(folder / "notify"))
        manager.setblocking(False)
        self._folder, self._manager = folder / "task", manager
        told = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "10000000"}
        self.notifier = Notifier(told)
        self.patience = Patience(self.notifier, self._folder)
        self.threads("SSS")

    def threads(self, states: str) -> None:
        """Each thread's state."""
        for number, state in enumerate(states, 1):
            (self._folder / str(number)).mkdir(parents=True, exist_ok=True)
            (self._folder / str(number) / "stat").write_text(f"{number} (a) R (b) {state} 1 1", encoding="ascii")

    def fed(self, *seconds: int) -> int:
        """How often the watchdog was fed while the patient thread looked at these times."""
        return sum(self._feeds(second) for second in seconds)

    def _feeds(self, second: int) -> int:
        self.patience.look(second * S)
        found = 0
        with suppress(BlockingIOError):
            while True:
                found += self._manager.recv(4096) == b"WATCHDOG=1"
        return found


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        yield World(tmp_path, manager)


def test_a_loop_that_waits_for_the_disk_is_fed_until_it_turns(world: World, caplog: pytest.LogCaptureFixture) -> None:
    world.notifier.working(10 * S)
    world.threads("DSS")
    assert world.fed(11, 12, 13, 14) == 1  # by the loop itself
    assert world.fed(*range(15, 40)) == 24  # from the second look on
    world.threads("SSS")
    world.notifier.working(40 * S)
    with caplog.at_level(logging.WARNING):
        assert world.fed(41, 42) == 1
    assert caplog.messages == ["the disk did not answer for 30 s"]


def test_a_loop_that_hangs_is_not_fed_though_other_threads_write_now_and_then(world: World) -> None:
    world.notifier.working(10 * S)
    assert world.fed(*range(11, 20)) == 1
    for second, states in enumerate(("SDS", "SSD", "SDS", "SSS", "SDS"), 20):
        world.threads(states)
        assert world.fed(second) == 0


def test_a_thread_that_has_ended_is_none_that_waits(world: World, tmp_path: Path) -> None:
    (tmp_path / "task" / "7").mkdir()
    assert world.fed(20, 21) == 0
