from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from dappled.workers import each, share, spans


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_part_is_worked_on_once(workers: int) -> None:
    done: list[int] = []
    each(done.append, range(100), workers)
    assert sorted(done) == list(range(100))


@pytest.mark.parametrize("workers", [1, 3])
def test_the_first_error_is_raised_and_ends_the_work(workers: int) -> None:
    def work(part: int) -> None:
        if part == 3:
            raise ValueError("the third")

    with pytest.raises(ValueError, match="the third"):
        each(work, range(50), workers)


def test_every_thread_has_work_of_its_own() -> None:
    owners: dict[int, set[int]] = {}

    def start() -> Callable[[int], None]:
        own = owners.setdefault(threading.get_ident(), set())
        return own.add

    share(start, range(40), 3)
    assert 1 <= len(owners) <= 3
    assert sorted(part for own in owners.values() for part in own) == list(range(40))


def test_spans_cover_all_of_it() -> None:
    assert spans(10, 4) == [slice(0, 4), slice(4, 8), slice(8, 10)]
