"""What a reader's process may take: memory, the disk, and the processor, whatever the file has it do."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dappled.drivers.python_command import python_module
from dappled.drivers.reader_process import Budget, read

READER = "tests.drivers.limited_reader"
MEMORY = 64 << 20
BUDGET = Budget(bytes_a_second=1e6, patience_s=60.0, memory=MEMORY, ratio=0)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of a thousand bytes, and `tests` where the process finds it."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    path = tmp_path / "file"
    path.write_bytes(bytes(1000))
    return path


def test_the_process_is_limited_before_it_reads(file: Path) -> None:
    _, text = read(READER, file, ["tell"], library="a", budget=BUDGET)
    limits = json.loads(text)
    assert limits["file"] == MEMORY
    assert limits["cpu"] == 61  # the patience, and a second for each million bytes begun
    assert MEMORY < limits["memory"] < MEMORY + (4 << 30)  # beside what Python and NumPy themselves map


def test_what_is_within_the_limits_is_read(file: Path) -> None:
    found, _ = read(READER, file, ["take memory", str(MEMORY // 4)], library="a", budget=BUDGET)
    assert found["a"].dtype == np.uint8
    assert found["a"].size == MEMORY // 4


@pytest.mark.parametrize("words", [["take memory", str(2 * MEMORY)], ["fill the disk"], ["fill the answer"]])
def test_beyond_them_it_is_one_sentence(file: Path, words: list[str]) -> None:
    with pytest.raises(MemoryError, match=r"it takes more memory or disk to read than is free, or than 67\.1 MB"):
        read(READER, file, words, library="a", budget=BUDGET)
    assert file.stat().st_size <= MEMORY


def test_one_that_calculates_without_end_is_ended_by_the_kernel_where_nobody_waits(file: Path, tmp_path: Path) -> None:
    command = python_module(READER, str(file), str(tmp_path / "out"), str(MEMORY), "1", "spin")
    assert subprocess.run(command, check=False, timeout=300, env=os.environ).returncode == -signal.SIGXCPU


def test_one_that_does_not_come_to_an_end_is_ended(file: Path) -> None:
    budget = Budget(bytes_a_second=1e9, patience_s=0.2)
    with pytest.raises(ValueError, match="the a library did not come to an end with it"):
        read(READER, file, ["spin"], library="a", budget=budget)
