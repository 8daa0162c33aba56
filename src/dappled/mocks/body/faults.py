"""Faults of a simulated body, put in force by words while it runs.

Lasting faults take seconds ("busy 2.5"; without a number: until "clear"), counted ones a number of times ("error 3";
without a number: once), "drop" happens at once, and "unplug" is both: it cuts the links and lasts.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator

from dappled.clock import Clock

LASTING = ("busy", "silence", "refuse", "unplug", "slow", "crawl", "full", "storage")
"""busy: a release is answered DeviceBusy. silence: nothing is answered. refuse: no new connection is accepted, as if
another program held the body. unplug: the links are cut, and no new one is accepted. slow: an object's data come
at 2 MB/s; crawl: at 0.5 MB/s. full: the card takes no more. storage: a body on USB describes itself as mass storage."""

COUNTED = ("error", "no-event", "short", "drop-transfer", "unplug-transfer", "stall", "babble", "no-focus")
"""error: a release is answered GeneralError. no-event: a new object isn't announced. short: an object's data end one
kilobyte early. drop-transfer: the link is cut in the middle of an object's data; unplug-transfer: it is, and stays so
until "clear". On USB only, in the middle of an object's data: stall: the endpoint is halted; babble: more comes than
was asked for. no-focus: a release is answered OK, and no picture is taken."""


_SILENCE_STEP_S = 0.02
_RATES = {"slow": 40_000, "crawl": 10_000}  # bytes at a time, 50 times a second
_BIG_BYTES = 65536


class BodyFaults:
    """The faults in force. All methods may be called from any thread. `drop` is called to cut the links."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._until_ns: dict[str, float] = {}
        self._left: dict[str, int] = {}
        self.drop: Callable[[], None] = lambda: None

    def command(self, line: str) -> None:
        """Put one fault in force. Raises ValueError with a sentence where the words aren't known."""
        name, *rest = line.split() or [""]
        if name == "clear":
            with self._lock:
                self._until_ns.clear()
                self._left.clear()
        elif name == "drop":
            self.drop()
        elif name in LASTING:
            seconds = float(rest[0]) if rest else math.inf
            with self._lock:
                self._until_ns[name] = self._clock.monotonic_ns() + seconds * 1e9
            if name == "unplug":
                self.drop()
        elif name in COUNTED:
            with self._lock:
                self._left[name] = int(rest[0]) if rest else 1
        else:
            known = ", ".join((*LASTING, *COUNTED, "drop", "clear"))
            raise ValueError(f"there is no fault {name!r}; known are {known}")

    def lasts(self, name: str) -> bool:
        """Whether a lasting fault is in force now."""
        with self._lock:
            return self._clock.monotonic_ns() < self._until_ns.get(name, -math.inf)

    def take(self, name: str) -> bool:
        """Whether a counted fault strikes now; uses one up."""
        with self._lock:
            left = self._left.get(name, 0)
            if left:
                self._left[name] = left - 1
            return left > 0

    def strikes(self, size: int) -> str:
        """The fault that strikes in the middle of so many bytes of data, "" where none does: the word of a fault that
        comes into force then, or "stall" or "babble". Uses one up."""
        ends = ("unplug-transfer", "drop-transfer", "stall", "babble")
        return next((name.removesuffix("-transfer") for name in ends if size > _BIG_BYTES and self.take(name)), "")

    def pieces(self, data: memoryview, ended: threading.Event) -> Iterator[memoryview]:
        """The data as fast as a body sends them."""
        while data and (rates := [rate for name, rate in _RATES.items() if self.lasts(name)]):
            yield data[: min(rates)]
            data = data[min(rates) :]
            ended.wait(_SILENCE_STEP_S)
        if data:
            yield data

    def wait_out_silence(self, ended: threading.Event) -> None:
        """Return when the body may answer again."""
        while self.lasts("silence") and not ended.wait(_SILENCE_STEP_S):
            pass
