"""Share work over threads so that the result is the same for any number of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import TypeVar

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
