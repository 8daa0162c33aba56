"""Run work on many files in processes of this machine, each with one thread. It survives the death of a process."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

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
class _Worker(Generic[Job]):
    process: BaseProcess
    channel: Connection
    number: int | None = None  # of its job
    until_s: float = 0.0  # when that is overdue


def worth(asked: int, jobs: int) -> int:
    """How many of the workers asked for so many jobs are worth their start; 1 is the process that asks."""
    return max(1, min(asked, jobs // _WORTH))


def in_order(
    jobs: Sequence[Job], make: Callable[[Job], Answer], workers: int, *, lost: Callable[[Job, str], Answer]
) -> Generator[Answer]:
    """The answers in the order of the jobs, from so many processes, or from this one where that is one."""
    yield from map(make, jobs) if workers == 1 else in_processes(jobs, make, workers, lost=lost, ordered=True)


def in_processes(
    jobs: Sequence[Job],
    make: Callable[[Job], Answer],
    workers: int,
    *,
    lost: Callable[[Job, str], Answer],
    ordered: bool = False,
    job_s: float = JOB_S,
    now_s: Callable[[], float] = time.monotonic,
) -> Iterator[Answer]:
    """Run jobs in a number of processes with one thread each, and yield their answers: as they are ready, or `ordered`
    as the jobs are. `make`, which is sent to each process once, must not raise.

    A process that dies, or does not answer for `job_s`, is replaced, and its job run again, three times in all; what is
    `lost` then gets a sentence's end that says why.
    """
    waiting = deque(range(len(jobs)))
    deaths: dict[int, int] = {}
    early: dict[int, Answer] = {}
    due = 0
    crew: list[_Worker[Job]] = []
    try:
        while waiting or any(worker.number is not None for worker in crew):
            while waiting and len(crew) < workers:
                crew.append(_hired(make))
            for worker in crew:
                if worker.number is None and waiting:
                    worker.number, worker.until_s = waiting.popleft(), now_s() + job_s
                    _hand(worker, jobs[worker.number])
            busy = [w for w in crew if w.number is not None]
            ready = wait([w.channel for w in busy], max(0.0, min(w.until_s for w in busy) - now_s()))
            for worker in [w for w in busy if w.channel in ready or now_s() >= w.until_s]:
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
                early[number] = answer
                if not ordered:
                    yield early.pop(number)
                while ordered and due in early:
                    yield early.pop(due)
                    due += 1
    finally:
        for worker in crew:
            _dismiss(worker)


def _hired(make: Callable[[Job], Answer]) -> _Worker[Job]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(there, make), daemon=True)
    with _environment(_ENVIRONMENT):
        process.start()
    there.close()
    return _Worker(process, here)


def _hand(worker: _Worker[Job], job: Job) -> None:
    try:
        worker.channel.send(job)
    except OSError:
        return  # it died at once: reading from it will raise


def _answer(worker: _Worker[Job]) -> Any:
    """Read a worker's answer. Raises EOFError or OSError where it will never answer."""
    if not worker.channel.poll():
        raise TimeoutError("overdue")
    return worker.channel.recv()


def _dismiss(worker: _Worker[Job]) -> None:
    worker.channel.close()
    worker.process.terminate()
    worker.process.join(5.0)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(channel: Connection, make: Callable[[Job], Answer]) -> None:
    """Run in a worker: read a job, send its result, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that hands out the jobs
    guard_output()
    single_threaded()
    while True:
        try:
            job: Job = channel.recv()
        except (EOFError, OSError):
            return
        channel.send(make(job))


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
