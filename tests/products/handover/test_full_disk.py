"""A disk that fills half way through a file: nothing half-written stands under its final name, in any form of a batch.

The kernel refuses what goes beyond a process' largest file (RLIMIT_FSIZE), whoever writes: Python, GDAL, HDF5.
"""

from __future__ import annotations

import resource
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.errors import DappledError
from dappled.products.batch import batch, workers
from dappled.products.batch.batch import Done, Job
from dappled.products.handover import FORMS, KINDS, forms
from dappled.products.maps.georeference import Options
from tests.products.flown import START_NS, Flown

pytestmark = pytest.mark.long  # a frame in all forms, twice: 20 s

LARGEST = 4096  # bytes: all that is made of a frame is larger, but its records


def full() -> None:
    """From here on this process can't write a file to its end."""
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, LARGEST))


def made(job: Job) -> Done:
    """A worker's part, on a full disk."""
    full()
    return batch.make(job)


def finished(job: Job) -> Done:
    """A worker's part: the last files of all forms, on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
    sys.dont_write_bytecode = True
    refused = {}
    for kind in (one for one in FORMS if one in job.kinds):
        folder = Path(job.output) / Path(job.flight).name / kind
        try:
            forms.finish(kind, folder, "flight", ["000000"])
        except (OSError, DappledError) as error:
            refused[kind] = str(error)
    return Done(job.key, "flight", job.frame.name, (), None, 0.0, 0.0, 0.0, refused)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_no_form_is_there_half(short_flight: Flown, tmp_path: Path) -> None:
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is part of the extra ros")
    options = Options(frames=frozenset({0}))
    (planned,) = batch.plan(short_flight.folder, short_flight.recipe, options, list(KINDS), tmp_path)
    job = replace(planned, utc_ns=START_NS)
    (done,) = workers.in_processes([job], made, 1)
    assert sorted(done.refused) == sorted(KINDS)
    assert all(len(data) < LARGEST for data in files(tmp_path).values()), "cut off at its largest size"
    (done,) = workers.in_processes([job], batch.make, 1)
    assert done.error is None
    folder = tmp_path / short_flight.folder.name
    for kind in FORMS:
        forms.finish(kind, folder / kind, "flight", ["000000"])
    before = files(tmp_path)
    (done,) = workers.in_processes([job], finished, 1)
    assert sorted(done.refused) == sorted(FORMS)
    assert files(tmp_path) == before
