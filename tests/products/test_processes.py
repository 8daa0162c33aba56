"""Work in several processes: answers in order, and a process that dies costs its own job alone."""

from __future__ import annotations

import multiprocessing
import os
import signal
from typing import Any

import pytest

from dappled.products import processes


def doubled(number: int) -> int:
    """What a worker does; 13 kills it."""
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def whose(_: int) -> int:
    """Another piece of work: the worker's own number."""
    return os.getpid()


def lost(number: int, why: str) -> Any:
    return f"{number} {why}"


def test_a_worker_is_hired_for_two_jobs_or_more() -> None:
    assert [processes.worth(2, jobs) for jobs in (0, 1, 2, 3, 4, 100)] == [1, 1, 1, 1, 2, 2]
    assert processes.worth(1, 100) == 1


def test_one_worker_is_the_process_that_asks() -> None:
    asked = os.getpid()
    with processes.Crew(1) as crew:
        assert list(crew.in_order([3, 1], lambda job: (job, os.getpid()), lost)) == [(3, asked), (1, asked)]


@pytest.mark.slow
def test_answers_come_in_order_and_a_job_that_kills_its_workers_is_told() -> None:
    jobs = [5, 13, 1, 4, 2]
    with processes.Crew(2) as crew:
        answers = list(crew.in_order(jobs, doubled, lost))
    assert answers[:1] + answers[2:] == [10, 2, 8, 4]
    assert "13 ended or held up 3 workers" in str(answers[1])


@pytest.mark.slow
def test_a_crew_is_kept_from_one_work_to_the_next_and_ends_with_it() -> None:
    with processes.Crew(2) as crew:
        first = set(crew.as_ready([1, 2, 3, 4], whose, lost))
        assert os.getpid() not in first
        assert sorted(crew.as_ready([1, 2], doubled, lost)) == [2, 4]
        asked = crew.as_ready([1, 2, 3], whose, lost)
        assert next(asked) in first
        asked.close()  # the other is busy: nobody waits for its answer
        assert sorted(crew.as_ready([5, 6], doubled, lost)) == [10, 12]
    assert not [child for child in multiprocessing.active_children() if child.is_alive()]
