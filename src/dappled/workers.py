"""Threads: `Loop` runs one function, `Worker` works off a bounded queue, `each` and `share` split work among several.

What `each` and `share` compute is the same for any number of threads. `one_blas_thread` keeps OpenBLAS from it.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Literal, TypeVar

from dappled.clock import Clock, SystemClock
from dappled.errors import report

Item = TypeVar("Item")
Policy = Literal["refuse", "drop oldest"]
log = logging.getLogger(__name__)


@dataclass(slots=True)
class Statistics:
    """What went through a queue so far. `waiting` is now; the rest only grow."""

    name: str
    capacity: int
    waiting: int = 0
    accepted: int = 0
    dropped: int = 0
    done: int = 0
    failed: int = 0


class Loop:
    """One daemon thread that calls `run` once; `run` returns soon after `stopping` is set.

    Loops that end together may share `stopping`. `clock` starts the thread, and knows its waits.
    """

    def __init__(
        self,
        name: str,
        run: Callable[[], None],
        stopping: threading.Event | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.name = name
        self.stopping = stopping or threading.Event()
        self._clock = clock or SystemClock()
        self._body = run
        self._thread: threading.Thread | None = None

    @property
    def begun(self) -> bool:
        """Whether it was started; it may have ended since."""
        return self._thread is not None

    def start(self) -> None:
        """Start the thread."""
        self._thread = self._clock.start(self._body, self.name)

    def stop(self, timeout_s: float) -> bool:
        """Set `stopping` and wait for the thread, unless it calls this itself. Whether it has ended, or never began."""
        self.stopping.set()
        thread = self._thread
        if thread is None:
            return True
        if thread.is_alive() and thread is not threading.current_thread():
            self._clock.join(thread, timeout_s)
        return not thread.is_alive()

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        ended = self._thread is not None and not self._thread.is_alive()
        return [self.name] if ended and not self.stopping.is_set() else []


class OneThread:
    """A part of the service whose only thread is a loop, `_loop`."""

    _loop: Loop

    def start(self) -> None:
        """Start the thread."""
        self._loop.start()

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped: never, unless there is a bug."""
        return self._loop.dead_threads()


class Worker(Loop, Generic[Item]):
    """One thread that does `work` on each item, in order, behind a bounded queue.

    Policy of a full queue: `refuse` turns the new item away, `drop oldest` removes its oldest item. Either way
    `on_drop` gets the item. An exception in `work` ends that item only: it is counted, and
    `on_failure`, which knows what the item is, reports it; without one the worker does.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Item], None],
        *,
        capacity: int,
        policy: Policy = "refuse",
        on_drop: Callable[[Item], None] | None = None,
        on_failure: Callable[[Item, Exception], None] | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(name, self._run, clock=clock)
        self._work = work
        self._policy = policy
        self._on_drop = on_drop
        self._on_failure = on_failure
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._busy = False
        self._counts = Statistics(name, capacity)

    def put(self, item: Item) -> bool:
        """Queue an item; False when it was turned away. Never waits."""
        lost: Item | None = None
        with self._changed:
            taken = not self.stopping.is_set()
            if taken and len(self._items) >= self._counts.capacity:
                if self._policy == "drop oldest":
                    lost = self._items.popleft()
                else:
                    taken = False
                self._counts.dropped += 1
            if taken:
                self._items.append(item)
                self._counts.accepted += 1
                self._changed.notify_all()
        if lost is not None or not taken:
            self._call(self._on_drop, item if lost is None else lost)
        return taken

    def stop(self, timeout_s: float) -> bool:
        """Take no more items, work off those that wait, end the thread.

        False when that took longer than `timeout_s`: then what still waits is dropped, and the thread ends after the
        item in hand.
        """
        with self._changed:
            self.stopping.set()
            self._changed.notify_all()
        ended = super().stop(timeout_s)
        with self._changed:
            left = list(self._items)
            self._items.clear()
            self._counts.dropped += len(left)
        for item in left:
            self._call(self._on_drop, item)
        return ended

    def statistics(self) -> Statistics:
        """Counters, taken together."""
        with self._changed:
            return replace(self._counts, waiting=len(self._items) + self._busy)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._clock.wait_for(self._changed, lambda: self._items or self.stopping.is_set(), None)
                if not self._items:
                    return
                item = self._items.popleft()
                self._busy = True
            try:
                self._work(item)
            except Exception as error:  # noqa: BLE001  # one bad item must not end the worker; it is counted
                with self._changed:
                    self._counts.failed += 1
                if self._on_failure is None:
                    report(log, self.name, error)
                self._call(self._on_failure, item, error)
            else:
                with self._changed:
                    self._counts.done += 1

    def _call(self, receiver: Callable[..., None] | None, *facts: object) -> None:
        try:
            if receiver:
                receiver(*facts)
        except Exception as error:  # noqa: BLE001  # nor must a receiver
            report(log, f"{self.name}: reporting an item", error)


def renice(by: int, task: int | None = None) -> None:
    """Change the niceness of the calling thread, or of a process that begins, by so much; others run before it where
    it grows. Raises OSError."""
    task = task or threading.get_native_id()
    os.setpriority(os.PRIO_PROCESS, task, os.getpriority(os.PRIO_PROCESS, task) + by)


Part = TypeVar("Part")


def each(work: Callable[[Part], None], parts: Iterable[Part], workers: int) -> None:
    """`work` on every part, which must not depend on `workers`. The first error is raised."""
    share(lambda: work, parts, workers)


def share(start: Callable[[], Callable[[Part], None]], parts: Iterable[Part], workers: int) -> None:
    """As `each`, but every thread calls `start` once for its own `work`, which may hold scratch memory."""
    waiting = list(parts)
    if workers <= 1 or len(waiting) < 2:
        work = start()
        for part in waiting:
            work(part)
        return
    left, lock, errors = iter(waiting), threading.Lock(), list[BaseException]()

    def run() -> None:
        try:
            work = start()
            while not errors:
                with lock:
                    part = next(left, None)
                if part is None:
                    return
                work(part)
        except BaseException as error:  # noqa: BLE001  # raised again in the caller's thread
            errors.append(error)

    threads = [threading.Thread(target=run, daemon=True) for _ in range(min(workers, len(waiting)) - 1)]
    for thread in threads:
        thread.start()
    run()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def spans(size: int, step: int) -> list[slice]:
    """0…size in runs of `step`."""
    return [slice(start, min(start + step, size)) for start in range(0, size, step)]


class _BlasThreads:
    """How many threads OpenBLAS has: one while someone is inside, then as many as before."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._before: list[tuple[Callable[[int], object], int]] = []

    @contextmanager
    def one(self) -> Iterator[None]:
        """Meanwhile the OpenBLAS of NumPy and SciPy computes in the calling threads alone, in the whole process.

        Matrices here are small, and its threads wait for each other with all cores busy. The command needs no such
        limit: it sets OPENBLAS_NUM_THREADS, which is read once, when NumPy is loaded.
        """
        with self._lock:
            if not self._inside:
                self._before = [(put, ask()) for ask, put in _openblas()]
                for put, _ in self._before:
                    put(1)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    for put, count in self._before:
                        put(count)


one_blas_thread = _BlasThreads().one


def _openblas() -> Iterator[tuple[Callable[[], int], Callable[[int], object]]]:
    """What asks for and what sets the number of threads of each OpenBLAS that is loaded; none where the system has no
    list of what is loaded."""
    listed = Path("/proc/self/maps")
    lines = listed.read_text("utf-8", "replace").splitlines() if listed.exists() else []
    mapped = [line.split(maxsplit=5) for line in lines]
    for path in sorted({words[5] for words in mapped if len(words) == 6 and "openblas" in Path(words[5]).name}):
        with suppress(OSError):  # replaced by another version since
            library = ctypes.CDLL(path)
            for before, after in itertools.product(("scipy_", ""), ("64_", "")):
                names = [f"{before}openblas_{what}_num_threads{after}" for what in ("get", "set")]
                if all(hasattr(library, name) for name in names):
                    yield getattr(library, names[0]), getattr(library, names[1])
