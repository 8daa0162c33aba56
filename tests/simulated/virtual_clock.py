"""A clock for whole systems in one process: one thread runs at a time, and when all wait, time jumps to the earliest
deadline. As trio's autojump clock and FoundationDB's simulation, for plain threads."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

_SWITCHES, _SWITCHED_S = 0.05, 0.01  # of the places where threads may change; and for how long at most
_TURNS = 100_000  # of threads at one moment: some thread asks without end whether something has come


class StuckError(AssertionError):
    """No thread of the simulation can go on, or time can't."""


@dataclass(slots=True, eq=False)
class _Waiting:
    """One thread. It goes on when its gate is opened: where `holds` is true, or from `until_ns` on."""

    name: str
    holds: Callable[[], object] = bool
    until_ns: float = 0.0
    gate: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.gate.acquire()


class VirtualClock:
    """See Clock. Use as a context manager in the thread that starts the others; at its end they must have ended.

    What is waited for needs no notice: whoever waits is asked again at each change of thread. `seed` chooses among
    threads that can go on at the same moment. Only real locks that are held while nothing waits are allowed.
    """

    def __init__(self, seed: int = 0, *, monotonic_ns: int = 10**12, utc_ns: int = 1_790_000_000 * 10**9) -> None:
        self._random = random.Random(seed)  # noqa: S311  # a simulation
        self._now_ns, self._utc_minus_monotonic_ns = monotonic_ns, utc_ns - monotonic_ns
        self._threads: dict[int, _Waiting] = {}
        self._paused: list[_Waiting] = []
        self._alive: set[threading.Thread] = set()
        self._turns = 0
        self._stuck = ""

    def __enter__(self) -> VirtualClock:
        self._first = self._threads[threading.get_ident()] = _Waiting("the test")
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None and self._alive:
            raise StuckError(f"threads that have not ended: {', '.join(sorted(one.name for one in self._alive))}")

    def monotonic_ns(self) -> int:
        """See Clock. Work takes no time."""
        return self._now_ns

    def utc_ns(self) -> int:
        """See Clock."""
        return self._now_ns + self._utc_minus_monotonic_ns

    def wait(self, event: threading.Event, timeout_s: float | None) -> bool:
        """See Clock."""
        self._pause(event.is_set, timeout_s)
        return event.is_set()

    pause = wait

    def wait_for(self, changed: threading.Condition, holds: Callable[[], object], timeout_s: float | None) -> bool:
        """See Clock."""
        if holds():
            return True
        changed.release()
        try:
            self._pause(holds, timeout_s)
        finally:
            changed.acquire()
        return bool(holds())

    def switch(self) -> None:
        """Now and then, let others run for a while. A thread that the clock does not know goes on."""
        if threading.get_ident() in self._threads and self._random.random() < _SWITCHES:
            self._pause(bool, self._random.uniform(0.0, _SWITCHED_S))

    def until(self, holds: Callable[[], object], timeout_s: float | None) -> bool:
        """Let the others run until this holds (True) or so much time has gone on (False; None: without end)."""
        self._pause(holds, timeout_s)
        return bool(holds())

    def sleep(self, seconds: float) -> None:
        """Let the others run for so long."""
        self._pause(bool, seconds)

    def start(self, run: Callable[[], None], name: str) -> threading.Thread:
        """See Clock. It begins when the others wait."""
        me = _Waiting(name, holds=lambda: True)

        def live() -> None:
            me.gate.acquire()
            self._threads[threading.get_ident()] = me
            try:
                run()
            finally:
                del self._threads[threading.get_ident()]
                self._alive.discard(thread)
                self._next().gate.release()

        thread = threading.Thread(target=live, name=name, daemon=True)
        self._alive.add(thread)
        self._paused.append(me)
        thread.start()
        return thread

    def join(self, thread: threading.Thread, timeout_s: float) -> None:
        """See Clock."""
        self._pause(lambda: thread not in self._alive, timeout_s)
        if thread not in self._alive:
            thread.join()  # it has handed on, and has nothing left to do

    def _pause(self, holds: Callable[[], object], timeout_s: float | None) -> None:
        """Let another thread run, until it holds or the time is over."""
        me = self._threads.get(threading.get_ident())
        if me is None:
            raise StuckError(f"{threading.current_thread().name} waits, and was not started by this clock")
        me.holds = holds
        me.until_ns = inf if timeout_s is None else self._now_ns + max(0, round(timeout_s * 1e9))
        self._paused.append(me)
        following = self._next()
        if following is not me:
            following.gate.release()
            me.gate.acquire()
        if me is self._first and self._stuck:
            raise StuckError(self._stuck)

    def _next(self) -> _Waiting:
        """The thread that goes on."""
        self._turns += 1
        if self._turns > _TURNS:
            return self._give_up(f"{_TURNS} turns at one moment")
        paused, now_ns = self._paused, self._now_ns
        if not (ready := [one for one in paused if one.until_ns <= now_ns or one.holds()]):
            earliest_ns = min([one.until_ns for one in paused], default=inf)
            if earliest_ns == inf:
                return self._give_up("all wait without end")
            self._now_ns, self._turns = int(earliest_ns), 0
            ready = [one for one in paused if one.until_ns <= earliest_ns]  # time alone changes nothing else
        chosen = ready[0] if len(ready) == 1 else self._random.choice(ready)
        self._paused.remove(chosen)
        return chosen

    def _give_up(self, why: str) -> _Waiting:
        self._stuck = f"{why}: {', '.join(sorted(one.name for one in self._paused))}"
        if self._first in self._paused:
            self._paused.remove(self._first)
        return self._first
