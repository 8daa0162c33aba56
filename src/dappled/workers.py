"""The street's crossings: bounded queues with a stated policy when full, and a thread that works each one off."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from dappled.errors import report

Item = TypeVar("Item")
Policy = Literal["refuse", "drop oldest"]
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Statistics:
    """What went through a queue so far. `waiting` is now; the rest only grow."""

    name: str
    capacity: int
    waiting: int
    accepted: int
    dropped: int
    done: int
    failed: int


class Worker(Generic[Item]):
    """One thread that does `work` on each item, in order, behind a bounded queue.

    `refuse`: a full queue turns the new item away. `drop oldest`: it loses its oldest. Either way `on_drop` is told.
    An exception in `work` ends that item only: it is counted, and `on_failure` is told.
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
    ) -> None:
        self.name = name
        self._work = work
        self._capacity = capacity
        self._policy = policy
        self._on_drop = on_drop
        self._on_failure = on_failure
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        self._accepted = self._dropped = self._done = self._failed = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without being asked to: never, unless there is a bug."""
        return [] if self._closed or self._thread.is_alive() else [self.name]

    def put(self, item: Item) -> bool:
        """Hand over an item; False when it was turned away. Never waits."""
        lost: Item | None = None
        with self._changed:
            taken = not self._closed
            if taken and len(self._items) >= self._capacity:
                if self._policy == "drop oldest":
                    lost = self._items.popleft()
                else:
                    taken = False
                self._dropped += 1
            if taken:
                self._items.append(item)
                self._accepted += 1
                self._changed.notify_all()
        if lost is not None or not taken:
            self._call(self._on_drop, item if lost is None else lost)
        return taken

    def wait_idle(self, timeout_s: float) -> bool:
        """Whether nothing waits and nothing is in hand, at the latest after `timeout_s`."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._items and not self._busy, timeout_s)

    def stop(self, timeout_s: float) -> bool:
        """Take no more, work off what waits, end the thread. False when that took longer than `timeout_s`: then what
        still waits is dropped, and the thread ends after the item in hand."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        with self._changed:
            left = list(self._items)
            self._items.clear()
            self._dropped += len(left)
        for item in left:
            self._call(self._on_drop, item)
        return not self._thread.is_alive()

    def statistics(self) -> Statistics:
        """Counters, taken together."""
        with self._changed:
            return Statistics(
                self.name,
                self._capacity,
                len(self._items) + self._busy,
                self._accepted,
                self._dropped,
                self._done,
                self._failed,
            )

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._items or self._closed)
                if not self._items:
                    return
                item = self._items.popleft()
                self._busy = True
            try:
                self._work(item)
            except Exception as error:  # noqa: BLE001  # one bad item must not end the stage; it is counted and told
                report(log, self.name, error)
                with self._changed:
                    self._failed += 1
                self._call(self._on_failure, item, error)
            else:
                with self._changed:
                    self._done += 1

    def _call(self, told: Callable[..., None] | None, *facts: object) -> None:
        try:
            if told:
                told(*facts)
        except Exception as error:  # noqa: BLE001  # nor must whoever is told
            report(log, f"{self.name}: telling it", error)
