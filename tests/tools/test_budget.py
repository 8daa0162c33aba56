"""A target ends as its tests end, and says what it took."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "budget.py"


@pytest.mark.parametrize(("cpu_s", "word"), [("400", ""), ("-1", ": over its budget")])
def test_it_ends_as_the_command_and_says_what_it_took(cpu_s: str, word: str) -> None:
    words = [sys.executable, str(TOOL), "make test", "240", cpu_s, sys.executable, "-c", "raise SystemExit(3)"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith("make test: ")
    assert done.stderr.endswith(f"CPU-s of {cpu_s}{word}\n")
