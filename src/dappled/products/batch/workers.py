"""Run the jobs of batches in processes of this machine or on a Dask cluster. A job survives the death of its worker.

Results come in the order in which they are ready.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from dappled.errors import DappledError
from dappled.products import processes
from dappled.products.batch.batch import Done, Job
from dappled.products.extras import need
from dappled.products.maps.laboratory import ShadowAsked, shadows
from dappled.products.processes import JOB_S

_PATIENCE_S = 10.0  # for the scheduler to answer
_WORKERS_S = 60.0  # for its first worker to be there

Make = Callable[[Job], Done]
_Job = TypeVar("_Job")
_Answer = TypeVar("_Answer")
_Run = Callable[[Sequence[Any], Callable[[Any], Any], Callable[[Any, str], Any]], Generator[Any]]
"""As `Crew.as_ready`."""


def in_processes(
    jobs: Sequence[Job], make: Make, workers: int, *, job_s: float = JOB_S, now_s: Callable[[], float] = time.monotonic
) -> Iterator[Done]:
    """Run jobs in a number of processes with one thread each, and yield their results."""
    with processes.Crew(workers, job_s=job_s, now_s=now_s) as crew:
        yield from _run(jobs, make, crew.as_ready)


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

        def as_ready(
            some: Sequence[_Job], made: Callable[[_Job], _Answer], lost: Callable[[_Job, str], _Answer]
        ) -> Generator[_Answer]:
            asked = {client.submit(made, job, key=f"dappled-{uuid4()}", pure=False): job for job in some}
            for future in distributed.as_completed(list(asked), loop=client.loop):
                finished = future.status == "finished"
                why = f"was given up by the cluster: {None if finished else future.exception()}"
                yield future.result() if finished else lost(asked[future], why)
                future.release()

        yield from _run(list({job.key: job for job in jobs}.values()), make, as_ready)


def _run(jobs: Sequence[Job], make: Make, run: _Run) -> Generator[Done]:
    """The jobs' results, as they are ready; first of all, the frames are asked for their shadows."""
    asked = [(job, [ShadowAsked(job.recipe, one) for one in job.others]) for job in jobs]
    told = shadows((one for _, few in asked for one in few), run)
    ready = [replace(job, told=tuple(told[one] for one in few if one in told)) for job, few in asked]
    with closing(run(ready, make, lambda job, why: given_up(job, f"{job.frame.name} {why}"))) as answers:
        yield from answers


def given_up(job: Job, why: str) -> Done:
    """The result of a job that no worker could finish."""
    return Done(job.key, Path(job.flight).name, job.frame.name, (), why, 0.0, 0.0, 0.0)
