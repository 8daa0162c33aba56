"""Run jobs in processes of this machine or on a Dask cluster. A job survives the death of its worker.

Results come in the order in which they are ready.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from dappled.errors import DappledError
from dappled.products.batch.batch import Done, Job
from dappled.products.extras import need
from dappled.shown import guard_output

ATTEMPTS = 3  # a frame that kills this many workers is given up
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",  # multiprocessing starts `python -c`, which takes modules from the current folder first
}
_PATIENCE_S = 10.0  # for the scheduler to answer
_WORKERS_S = 60.0  # for its first worker to be there
JOB_S = 900.0  # a frame takes seconds: a worker that has not answered for so long hangs

Make = Callable[[Job], Done]


@dataclass(slots=True)
class _Worker:
    process: BaseProcess
    channel: Connection
    job: Job | None = None
    until_s: float = 0.0  # when its job is overdue


def in_processes(
    jobs: Sequence[Job], make: Make, workers: int, *, job_s: float = JOB_S, now_s: Callable[[], float] = time.monotonic
) -> Iterator[Done]:
    """Run jobs in a number of processes with one thread each, and yield their results.

    A process that dies, or does not answer for `job_s`, is replaced, and its job run again, three times in all.
    """
    waiting = deque(jobs)
    deaths: dict[str, int] = {}
    crew: list[_Worker] = []
    try:
        while waiting or any(worker.job is not None for worker in crew):
            while waiting and len(crew) < workers:
                crew.append(_hired(make))
            for worker in crew:
                if worker.job is None and waiting:
                    worker.job, worker.until_s = waiting.popleft(), now_s() + job_s
                    _hand(worker, worker.job)
            busy = [w for w in crew if w.job is not None]
            ready = wait([w.channel for w in busy], max(0.0, min(w.until_s for w in busy) - now_s()))
            for worker in [w for w in busy if w.channel in ready or now_s() >= w.until_s]:
                job = worker.job
                assert job is not None
                try:
                    answer = _answer(worker)
                except (EOFError, OSError):
                    crew.remove(worker)
                    _dismiss(worker)
                    deaths[job.key] = deaths.get(job.key, 0) + 1
                    if deaths[job.key] < ATTEMPTS:
                        waiting.appendleft(job)
                        continue
                    answer = given_up(
                        job, f"{job.frame.name} ended or held up {ATTEMPTS} workers: out of memory, or damaged?"
                    )
                worker.job = None
                yield answer
    finally:
        for worker in crew:
            _dismiss(worker)


def on_cluster(jobs: Sequence[Job], make: Make, scheduler: str) -> Iterator[Done]:
    """Run jobs on the workers of a Dask scheduler, which must see the same folders under the same names.

    Raises DappledError where the scheduler does not answer, or has no worker within a minute.
    """
    distributed = need("distributed")
    try:
        client = distributed.Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise DappledError(
            f"no Dask scheduler answers at {scheduler} ({error}): start one with dask scheduler"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError:
            raise DappledError(
                f"the Dask scheduler at {scheduler} has no workers: start some with dask worker {scheduler}"
            ) from None
        named = {job.key: job for job in jobs}
        futures = [client.submit(make, job, key=f"dappled-{job.key}", pure=False) for job in named.values()]
        for future in distributed.as_completed(futures, loop=client.loop):
            key = future.key.removeprefix("dappled-")
            if future.status == "finished":
                yield future.result()
            else:
                yield given_up(named[key], f"{named[key].frame.name}: the cluster gave it up: {future.exception()}")
            future.release()


def given_up(job: Job, why: str) -> Done:
    """The result of a job that no worker could finish."""
    return Done(job.key, Path(job.flight).name, job.frame.name, (), why, 0.0, 0.0, 0.0)


def _hired(make: Make) -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(there, make), daemon=True)
    with _environment(_ENVIRONMENT):
        process.start()
    there.close()
    return _Worker(process, here)


def _hand(worker: _Worker, job: Job) -> None:
    try:
        worker.channel.send(job)
    except OSError:
        return  # it died at once: reading from it will raise


def _answer(worker: _Worker) -> Done:
    """Read a worker's answer. Raises EOFError or OSError where it will never answer."""
    if not worker.channel.poll():
        raise TimeoutError("overdue")
    answer: Done = worker.channel.recv()
    return answer


def _dismiss(worker: _Worker) -> None:
    worker.channel.close()
    worker.process.terminate()
    worker.process.join(5.0)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _work(channel: Connection, make: Make) -> None:
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
