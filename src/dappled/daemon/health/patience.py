"""Have systemd's watchdog wait while the main loop stands still because the disk does."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from pathlib import Path

from dappled.daemon.health.systemd import Notifier
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)


class Patience(OneThread):
    """Feeds the watchdog while the main loop waits for the disk. A loop that hangs otherwise is not fed.

    A memory card that tidies up may not answer for many seconds; as packets are logged, none is sent meanwhile. A
    process that waits in the kernel can't be killed, and a restart mends no disk: it would only cut the flight.
    """

    def __init__(self, notifier: Notifier, threads: Path = Path("/proc/self/task")) -> None:
        self._notifier, self._threads = notifier, threads
        self._waited = frozenset[str]()
        self._since_ns: int | None = None
        self._loop = Loop("patience", self._run)

    def stop(self) -> None:
        """End the thread."""
        self._loop.stop(1.0)

    def look(self, now_ns: int) -> None:
        """Feed the watchdog if half its time has passed since the loop turned, and a thread has waited in the kernel
        since the last look."""
        turned_ns = self._notifier.fed_ns
        late = now_ns - turned_ns >= self._notifier.watchdog_ns // 2
        waiting = _waiting(self._threads) if late else frozenset[str]()
        if waiting & self._waited:
            self._since_ns = turned_ns
            self._notifier.feed()
            self._notifier.status("the disk does not answer")
        elif not late and self._since_ns is not None:
            log.warning("the disk did not answer for %.0f s", (turned_ns - self._since_ns) / 1e9)
            self._since_ns = None
        self._waited = waiting

    def _run(self) -> None:
        while not self._loop.stopping.wait(self._notifier.watchdog_ns / 1e10):
            self.look(time.monotonic_ns())


def _waiting(threads: Path) -> frozenset[str]:
    """The threads that wait in the kernel for a device: state D of proc_pid_stat(5)."""
    found = set[str]()
    for thread in threads.iterdir():
        with suppress(OSError, IndexError):  # it has ended
            if (thread / "stat").read_text("utf-8", "replace").rpartition(")")[2].split()[0] == "D":
                found.add(thread.name)
    return frozenset(found)
