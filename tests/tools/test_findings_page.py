"""The page of all findings is that of the table, and leads to pages that are there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dappled.findings import WORDS

ROOT = Path(__file__).parents[2]


def test_the_page_of_all_findings_is_that_of_the_table() -> None:
    made = subprocess.run(
        [sys.executable, "-c", "import findings_page; print(findings_page.page(), end='')"],
        cwd=ROOT / "tools",
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ROOT / "docs" / "findings.md").read_text("utf-8") == made.stdout, "run tools/findings_page.py"


def test_each_finding_leads_to_a_page_that_is_there() -> None:
    assert all((ROOT / "docs" / words.page.partition("#")[0]).exists() for words in WORDS.values() if words.page)
