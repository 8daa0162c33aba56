"""Run the jobs of batches in processes of this machine or on a Dask cluster. A job survives the death of its worker.

Results come in the order in which they are ready.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from dappled.errors import DappledError
from dappled.products import processes
from dappled.products.batch.batch import Done, Job
from dappled.products.extras import need
from dappled.products.processes import JOB_S

_PATIENCE_S = 10.0  # for the scheduler to answer
_WORKERS_S = 60.0  # for its first worker to be there

Make = Callable[[Job], Done]


def in_processes(
    jobs: Sequence[Job], make: Make, workers: int, *, job_s: float = JOB_S, now_s: Callable[[], float] = time.monotonic
) -> Iterator[Done]:
    """Run jobs in a number of processes with one thread each, and yield their results."""

    def lost(job: Job, why: str) -> Done:
        return given_up(job, f"{job.frame.name} {why}")

    return processes.in_processes(jobs, make, workers, lost=lost, job_s=job_s, now_s=now_s)


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
