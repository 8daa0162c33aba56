"""Each promise of docs/security.md names the test that attacks it, and that test is there."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_is_made_from_the_promises() -> None:
    made = subprocess.run(
        [sys.executable, "-c", "import promises_page; print(promises_page.page(), end='')"],
        cwd=ROOT / "tools",
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ROOT / "docs" / "security.md").read_text("utf-8") == made.stdout, "run tools/promises_page.py"


def test_each_promise_names_a_test_that_is_there() -> None:
    promises = tomllib.loads((ROOT / "tests" / "promises.toml").read_text("utf-8"))["promise"]
    assert len({one["that"] for one in promises}) == len(promises) > 50
    for one in promises:
        file, _, test = one["test"].partition("::")
        tree = ast.parse((ROOT / file).read_text("utf-8"))
        assert test in [each.name for each in tree.body if isinstance(each, ast.FunctionDef)], one
