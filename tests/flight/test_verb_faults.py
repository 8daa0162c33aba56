"""Every call that changes files fails once, or from then on, in each verb that writes (see `verbs`).

EIO, ENOSPC and EMFILE at each call of Python and of SQLite: the verb says a sentence or ends well, no acknowledged
frame is lost, and called again it comes to its end.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.flight.verbs import VERBS

HERE = Path(__file__).parent
FEWEST = {"geotag": 700}  # refused faults at least, with each call: it makes 181, of which 1086 faults can come


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler: no call can be made to fail")
    made = tmp_path_factory.mktemp("faults") / "faults.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(made), str(HERE / "faults.c"), "-ldl"], check=True)
    return made


@pytest.fixture
def place() -> Iterator[Path]:
    """In memory where there is such a place: thousands of files are written."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="dappled-fault-", dir=memory if memory.is_dir() else None) as name:
        yield Path(name)


def sweep(shim: Path, name: str, place: Path, step: int) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.flight.fault_server", name, str(place), str(step)],
        cwd=HERE.parents[1], env={**os.environ, "LD_PRELOAD": str(shim)}, capture_output=True, text=True, check=False,
        timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(  # noqa: T201  figures for people who run with -s
        f"{name}: {found['faults']} faults at {found['calls']} calls, {found['refused']} refused in a sentence, "
        f"{len(found['wrong'])} wrong"
    )
    return found


@pytest.mark.parametrize(
    ("name", "step"), [("offload", 499), *(pytest.param(one, 151, marks=pytest.mark.slow) for one in VERBS)]
)
def test_some_calls_that_fail_lose_no_frame(shim: Path, place: Path, name: str, step: int) -> None:
    found = sweep(shim, name, place, step)
    assert found["wrong"] == []
    assert found["refused"] > FEWEST.get(name, 755) / step


@pytest.mark.long
@pytest.mark.timeout(1000)
@pytest.mark.parametrize("name", VERBS)
def test_more_calls_that_fail_lose_no_frame(shim: Path, place: Path, name: str) -> None:
    found = sweep(shim, name, place, int(os.environ.get("DAPPLED_FAULT_STEP", "17")))  # 1: every call; it takes an hour
    assert found["wrong"] == []
    assert found["refused"] > 5
