"""Pages of docs/ that a tool makes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def assert_made(page: str, tool: str) -> None:
    """The page in docs/ is what the tool in tools/ makes today."""
    made = subprocess.run(
        [sys.executable, "-c", f"import {tool}; print({tool}.page(), end='')"],
        cwd=ROOT / "tools",
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ROOT / "docs" / page).read_text("utf-8") == made.stdout, f"run tools/{tool}.py"
