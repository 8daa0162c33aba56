"""The notebooks of docs/notebooks run from the top in an empty folder; what is kept of them is small."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LARGEST = 300_000  # bytes


def outputs(path: Path) -> list[Any]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [output for cell in cells for output in cell.get("outputs", ())]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_is_kept_small_with_its_pictures(path: Path) -> None:
    assert path.stat().st_size < LARGEST
    kept = outputs(path)
    assert any("image/jpeg" in output.get("data", {}) for output in kept)
    assert not any(output["output_type"] == "error" for output in kept)
    assert "/tmp/" not in json.dumps(kept)  # no name of the machine that ran it


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_runs_from_the_top(path: Path) -> None:
    tool = ROOT / "tools" / "notebooks.py"
    done = subprocess.run([sys.executable, tool, path.stem], capture_output=True, text=True, timeout=880, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_there_are_three() -> None:
    assert len(NOTEBOOKS) == 3
