"""What a test leaves behind for the next one: threads, child processes, sockets and open files.

Each costs the next test: a socket that nobody closed is warned of whenever the garbage is collected, in a test that has
nothing to do with it; and a daemon that leaves a file open at each frame ends in the middle of a flight. A fixture of a
wider scope may keep what it made until its own end.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

GRACE_S = 30.0
# Libraries start one of these for the life of the process, when they first need it: pyzmq, for messages that are sent
# without a copy; tqdm; Zarr, a loop of asyncio with its own two sockets; multiprocessing.
FOREVER = ("GarbageCollectorThread", "TMonitor")
ZARR = ("zarr_io", "asyncio_")
# Where tests have their files.
FILES = "/pytest-of-"
TRACKER = "from multiprocessing.resource_tracker"

Held = frozenset[tuple[str, str]]


def held() -> Held:
    """What this process holds by now: (kind, which one)."""
    found = {
        ("thread", f"{one.name} {one.ident}") for one in threading.enumerate() if type(one).__name__ not in FOREVER
    }
    for name in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{name}")
        except OSError:  # closed since
            continue
        if target.startswith("socket:"):
            found.add(("socket", f"{name} {target}"))
        elif FILES in target:
            found.add(("file", f"{name} {target}"))
    for task in os.listdir("/proc/self/task"):
        try:
            with open(f"/proc/self/task/{task}/children", "rb", buffering=0) as file:
                found |= {("process", child.decode()) for child in file.read().split()}
        except OSError:  # a thread that has ended since, or a kernel that does not tell
            continue
    return frozenset(found)


class Watch:
    """Knows what fixtures of a wider scope have made, and what libraries keep."""

    def __init__(self) -> None:
        self.kept: Held = frozenset()

    @contextmanager
    def wider(self) -> Iterator[None]:
        """What is made in here may stay."""
        before = held()
        yield
        self.kept |= held() - before

    def left(self, before: Held) -> Held:
        """What is there and was not before, after as long as it may take to end."""
        left = self._left(before)
        if any(kind == "file" for kind, _ in left):
            gc.collect()  # sqlite3's connections are cycles: when they are closed by themselves is chance
        until = time.monotonic() + GRACE_S
        while left and (left := self._left(before)) and time.monotonic() < until:
            threading.Event().wait(0.01)
        return left

    def _left(self, before: Held) -> Held:
        left = held() - before - self.kept
        theirs = {one for one in left if one[0] == "thread" and one[1].startswith(ZARR)}
        theirs |= {one for one in left if one[0] == "process" and TRACKER in command(one[1])}
        if any(which.startswith("zarr_io") for _, which in theirs):
            theirs |= {one for one in left if one[0] == "socket"}
        self.kept |= theirs
        return left - theirs


def command(process: str) -> str:
    """What a process was started as; "" where it has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def named(left: Held) -> str:
    """What was left, with what processes were started as."""
    said = (f"{kind} {which} {command(which)[:200] if kind == 'process' else ''}" for kind, which in sorted(left))
    return "; ".join(one.strip() for one in said)
