"""What is expensive is made once for all workers of a test run, and not to be written to."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

Made = TypeVar("Made")


def folder_of_run(factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of this run of tests have in common."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@contextmanager
def alone(folder: Path, name: str) -> Iterator[Path]:
    """A folder that one worker uses at a time."""
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / name).mkdir(exist_ok=True)
        yield folder / name


def once(folder: Path, name: str, make: Callable[[], Made]) -> Made:
    """What `make` gives, from whichever worker asked first. It must pickle."""
    kept = folder / f"{name}.pickle"
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if kept.exists():
            made: Made = pickle.loads(kept.read_bytes())  # noqa: S301  # what this run wrote
            return made
        made = make()
        part = kept.with_suffix(".part")
        part.write_bytes(pickle.dumps(made, protocol=5))
        part.rename(kept)
        return made
