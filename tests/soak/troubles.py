"""Make things go wrong in a soak: faults by name, chosen at random, and cleared again."""

from __future__ import annotations

import os
import random
import re
import select
import signal
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from dappled.config import settings as configuration
from dappled.drivers.python_command import python_module
from dappled.mocks.simulation import Simulation
from tests.soak.supervised import Supervised

CAMERA = ("busy 2", "silence 3", "error", "no-event", "short", "drop", "drop-transfer", "refuse 3")
HEAR_S = 5.0


class RebootingSimulation(Simulation):
    """One whose autopilot can be restarted."""

    def reboot_autopilot(self) -> None:
        """Restart the autopilot: its time since boot starts again, and the flight goes on."""
        self._autopilot.stop()
        self._autopilot = self._start_autopilot(-(time.monotonic_ns() - self.start_monotonic_ns) / 1e9)


class Troubles:
    """Faults of camera, link, disk, subscribers, console, and processes. Use as a context manager."""

    def __init__(
        self, simulation: RebootingSimulation, daemon: Supervised, config: Path, chance: random.Random
    ) -> None:
        """`config` is the daemon's: it names the stream and the console, and is rewritten to fill the disk."""
        self._simulation, self._daemon, self._config = simulation, daemon, config
        settings = configuration.load(config)
        self._stream, self._console = settings.publish.slices, settings.console.bind
        self._chance = chance
        self._settings = config.read_text(encoding="utf-8")
        self._subscribers: list[subprocess.Popen[bytes]] = []
        self._pages: list[socket.socket] = []
        self._full = False
        self.counts: Counter[str] = Counter()
        self._known: dict[str, Callable[[], None]] = {
            "camera process killed": lambda: self._kill_child("dappled.drivers.gphoto2.process"),
            "decode process killed": lambda: self._kill_child("dappled.daemon.pipeline.decode_worker"),
            "autopilot reboots": simulation.reboot_autopilot,
            "noise on the link": self._noise,
            "disk full": self._disk,
            "subscriber hangs": lambda: self._watch(signal.SIGSTOP),
            "subscriber killed": lambda: self._watch(signal.SIGKILL),
            "console process killed": lambda: self._kill_child("daemon.console"),
            "page stops reading": self._page,
        }
        for fault in CAMERA:
            self._known[f"camera: {fault}"] = lambda fault=fault: simulation.body.fault(fault)  # type: ignore[misc]  # bound now

    def __enter__(self) -> Troubles:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def strike(self, *, daemon_may_die: bool) -> str:
        """Make one fault, chosen at random. Returns its name. A full disk is free again at the next one."""
        if self._full:
            self._disk()
        names = [*self._known, *(["daemon killed"] if daemon_may_die else [])]
        name = self._chance.choice(names)
        self.counts[name] += 1
        if name == "daemon killed":
            self._daemon.kill()
        else:
            self._known[name]()
        return name

    def clear(self) -> None:
        """End every lasting fault."""
        self._simulation.body.fault("clear")
        if self._full:
            self._disk()
        for subscriber in self._subscribers:
            _end(subscriber)
        self._subscribers.clear()
        for page in self._pages:
            page.close()
        self._pages.clear()

    def _kill_child(self, name: str) -> None:
        with suppress(FileNotFoundError, ProcessLookupError):  # it, or the daemon, is starting or ending
            for pid, line in self._daemon.children().items():
                if name in line:
                    os.kill(pid, signal.SIGKILL)

    def _noise(self) -> None:
        """Random bytes to every UDP port that the daemon listens on."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for url in (self._simulation.ground_url, self._simulation.autopilot_url):
                host, _, port = url.removeprefix("udpout:").partition(":")
                for _ in range(200):
                    out.sendto(self._chance.randbytes(self._chance.randint(1, 280)), (host, int(port)))

    def _disk(self) -> None:
        """Require more free space than there is, or none again; a running daemon reads it on SIGHUP."""
        self._full = not self._full
        wanted = 10_000_000 if self._full else 500
        changed = re.sub(r"min_free_mb = \d+", f"min_free_mb = {wanted}", self._settings)
        self._config.write_text(changed, encoding="utf-8")
        with suppress(ProcessLookupError):
            self._daemon.signal(signal.SIGHUP)

    def _page(self) -> None:
        """Open a page that requests events and never reads them."""
        host, _, port = self._console.partition(":")
        with suppress(OSError):  # the console may be starting
            page = socket.create_connection((host, int(port)), 2.0)
            self._pages.append(page)
            page.sendall(f"GET /api/events HTTP/1.1\r\nHost: {self._console}\r\n\r\n".encode())
        if len(self._pages) > 4:
            self._pages.pop(0).close()

    def _watch(self, then: signal.Signals) -> None:
        """Start a subscriber that connects, receives something, and then hangs or dies."""
        if len(self._subscribers) >= 4:
            _end(self._subscribers.pop(0))
        command = python_module("dappled", "watch", self._stream, "--timeout", "600")
        subscriber = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._subscribers.append(subscriber)
        assert subscriber.stdout is not None
        select.select([subscriber.stdout], [], [], HEAR_S)
        subscriber.send_signal(then)


def _end(subscriber: subprocess.Popen[bytes]) -> None:
    subscriber.kill()
    subscriber.communicate(timeout=5)
