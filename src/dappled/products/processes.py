"""Run work on many files in processes of this machine, each with one thread. It survives the death of a process."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from dappled.closing import Closing
from dappled.errors import DappledError
from dappled.large_blocks import reuse_large_blocks
from dappled.shown import guard_output

ATTEMPTS = 3  # a job that kills this many workers is given up
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",  # multiprocessing starts `python -c`, which takes modules from the current folder first
}
JOB_S = 900.0  # a frame takes seconds: a worker that has not answered for so long hangs
_WORTH = 2  # jobs that a worker must have before it is hired: it loads for a second

Job = TypeVar("Job")
Answer = TypeVar("Answer")


@dataclass(slots=True)
class _Worker:
    process: BaseProcess
    channel: Connection
    make: Callable[[Any], Any] | None = None  # what it does with its jobs
    number: int | None = None  # of its job
    until_s: float = 0.0  # when that is overdue


def worth(asked: int, jobs: int) -> int:
    """How many of the workers asked for so many jobs are worth their start; 1 is the process that asks."""
    return max(1, min(asked, jobs // _WORTH))


class Crew(Closing):
    """So many processes with one thread each, for one piece of work after the other. Use as a context manager.

    Processes are started when there are jobs for them. `make`, which is sent to each of them once, must not raise. One
    that dies, or does not answer for `job_s`, is replaced, and its job run again, three times in all; what is `lost`
    then gets a sentence's end that says why.
    """

    def __init__(self, workers: int, *, job_s: float = JOB_S, now_s: Callable[[], float] = time.monotonic) -> None:
        self.workers = workers
        self._job_s, self._now_s = job_s, now_s
        self._crew: list[_Worker] = []

    def close(self) -> None:
        for worker in self._crew:
            _dismiss(worker)

    def in_order(
        self, jobs: Sequence[Job], make: Callable[[Job], Answer], lost: Callable[[Job, str], Answer]
    ) -> Generator[Answer]:
        """The answers in the order of the jobs; of one worker's jobs, from this process."""
        if self.workers == 1:
            reuse_large_blocks()
            yield from map(make, jobs)
            return
        early: dict[int, Answer] = {}
        due = 0
        with closing(self._numbered(jobs, make, lost)) as answers:
            for number, answer in answers:
                early[number] = answer
                while due in early:
                    yield early.pop(due)
                    due += 1

    def as_ready(
        self, jobs: Sequence[Job], make: Callable[[Job], Answer], lost: Callable[[Job, str], Answer]
    ) -> Generator[Answer]:
        """The answers in the order in which they are ready, all from other processes."""
        with closing(self._numbered(jobs, make, lost)) as answers:
            for _, answer in answers:
                yield answer

    def _numbered(
        self, jobs: Sequence[Job], make: Callable[[Job], Answer], lost: Callable[[Job, str], Answer]
    ) -> Generator[tuple[int, Answer]]:
        waiting = deque(range(len(jobs)))
        deaths: dict[int, int] = {}
        crew = self._crew
        try:
            while waiting or any(worker.number is not None for worker in crew):
                idle = sum(worker.number is None for worker in crew)
                while len(waiting) > idle and len(crew) < self.workers:
                    crew.append(_hired())
                    idle += 1
                for worker in crew:
                    if worker.number is None and waiting:
                        worker.number, worker.until_s = waiting.popleft(), self._now_s() + self._job_s
                        _hand(worker, make, jobs[worker.number])
                busy = [w for w in crew if w.number is not None]
                ready = wait([w.channel for w in busy], max(0.0, min(w.until_s for w in busy) - self._now_s()))
                for worker in [w for w in busy if w.channel in ready or self._now_s() >= w.until_s]:
                    number = worker.number
                    assert number is not None
                    answer: Answer
                    try:
                        answer = _answer(worker)
                    except (EOFError, OSError):
                        crew.remove(worker)
                        _dismiss(worker)
                        deaths[number] = deaths.get(number, 0) + 1
                        if deaths[number] < ATTEMPTS:
                            waiting.appendleft(number)
                            continue
                        answer = lost(jobs[number], f"ended or held up {ATTEMPTS} workers: out of memory, or damaged?")
                    worker.number = None
                    yield number, answer
        finally:
            for worker in [one for one in crew if one.number is not None]:  # what was asked is wanted no more
                crew.remove(worker)
                _dismiss(worker)


def _hired() -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(there,), daemon=True)
    with _environment(_ENVIRONMENT):
        process.start()
    there.close()
    return _Worker(process, here)


def _hand(worker: _Worker, make: Callable[[Job], Answer], job: Job) -> None:
    try:
        worker.channel.send((None if worker.make is make else make, job))
    except OSError:
        return  # it died at once: reading from it will raise
    worker.make = make


def _answer(worker: _Worker) -> Any:
    """Read a worker's answer. Raises EOFError or OSError where it will never answer."""
    if not worker.channel.poll():
        raise TimeoutError("overdue")
    return worker.channel.recv()


def _dismiss(worker: _Worker) -> None:
    worker.channel.close()
    worker.process.terminate()
    worker.process.join(5.0)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(channel: Connection) -> None:
    """Run in a worker: read a job, and what is made of it where that is new, send its result, until the pipe is
    closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that hands out the jobs
    guard_output()
    reuse_large_blocks()
    single_threaded()
    make: Callable[[Any], Any] | None = None
    while True:
        try:
            new, job = channel.recv()
        except (EOFError, OSError):
            return
        make = new or make
        assert make is not None
        channel.send(make(job))


def tried(make: Callable[[Job], Answer], job: Job) -> Answer | DappledError:
    """What is made of a job, or why not, as it may come from another process."""
    try:
        return make(job)
    except DappledError as error:
        return DappledError(error.finding or str(error))


def single_threaded() -> None:
    """Switch off OpenCV's own threads: frames run in parallel instead."""
    try:
        import cv2  # noqa: PLC0415  an extra; light fields are made without it
    except ImportError:
        return
    cv2.setNumThreads(1)


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started in the meantime."""
    before: dict[str, Any] = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
