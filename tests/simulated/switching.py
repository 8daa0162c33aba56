"""Threads that change at locks: under `switching`, every lock and every write of the daemon's is a place where the
virtual clock may let another thread go first, by seed. A lock that is missing, or let go of too early, then shows."""

from __future__ import annotations

import os
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from tests.simulated.virtual_clock import VirtualClock

_REAL = {"dappled.daemon.health.logbook"}  # held inside a lock of `logging`
_CALLS = ("write", "fsync", "fdatasync", "replace", "rename")


class SwitchingLock:
    """A Lock, an RLock (`reentrant`) or a Condition of a virtual clock."""

    def __init__(self, clock: VirtualClock, *, reentrant: bool) -> None:
        self._clock, self._reentrant = clock, reentrant
        self._owner: int | None = None
        self._depth = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        me = threading.get_ident()
        if self._reentrant and self._owner == me:
            self._depth += 1
            return True
        self._clock.switch()
        if self._owner is not None:
            if not blocking:
                return False
            if not self._clock.until(lambda: self._owner is None, None if timeout < 0 else timeout):
                return False
        self._owner, self._depth = me, 1
        return True

    def release(self) -> None:
        assert self._owner == threading.get_ident(), "released by a thread that does not hold it"
        self._depth -= 1
        if not self._depth:
            self._owner = None

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def notify(self, _count: int = 1) -> None:
        """Whoever waits is asked again by the clock."""

    notify_all = notify


@contextmanager
def switching(clock: VirtualClock) -> Iterator[None]:
    """What of dappled is built meanwhile has switching locks. `clock` knows its threads."""
    made = {
        "Lock": lambda: SwitchingLock(clock, reentrant=False),
        "RLock": lambda: SwitchingLock(clock, reentrant=True),
        "Condition": lambda: SwitchingLock(clock, reentrant=True),
    }
    instead = SimpleNamespace(**{name: getattr(threading, name) for name in dir(threading)} | made)
    with ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            if name.startswith("dappled.") and name not in _REAL and getattr(module, "threading", None) is threading:
                stack.enter_context(patch.object(module, "threading", instead))
        for name in _CALLS:
            stack.enter_context(patch.object(os, name, _between_switches(clock, getattr(os, name))))
        connect = partial(sqlite3.connect, factory=_switching_connection(clock))
        stack.enter_context(patch.object(sqlite3, "connect", connect))
        yield


def _switching_connection(clock: VirtualClock) -> type[sqlite3.Connection]:
    class Connection(sqlite3.Connection):
        execute = _between_switches(clock, sqlite3.Connection.execute)

    return Connection


def _between_switches(clock: VirtualClock, call: Callable[..., Any]) -> Callable[..., Any]:
    def switched(*words: Any, **more: Any) -> Any:
        clock.switch()
        done = call(*words, **more)
        clock.switch()
        return done

    return switched
