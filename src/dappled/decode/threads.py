"""Work shared out over threads so that the result is the same for any number of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")


def each(work: Callable[[Part], None], parts: Iterable[Part], workers: int) -> None:
    """`work` on every part, which must not depend on `workers`. The first error is raised."""
    parts = list(parts)
    if workers <= 1 or len(parts) < 2:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(min(workers, len(parts))) as pool:
        for _ in pool.map(work, parts):
            pass


def spans(size: int, step: int) -> list[slice]:
    """0…size in runs of `step`."""
    return [slice(start, min(start + step, size)) for start in range(0, size, step)]
