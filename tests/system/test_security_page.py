"""Each promise of docs/security.md names the test that attacks it, and that test is there."""

from __future__ import annotations

import ast
import tomllib

from tests.made_pages import ROOT, assert_made


def test_the_page_is_made_from_the_promises() -> None:
    assert_made("security.md", "promises_page")


def test_each_promise_names_a_test_that_is_there() -> None:
    promises = tomllib.loads((ROOT / "tests" / "promises.toml").read_text("utf-8"))["promise"]
    assert len({one["that"] for one in promises}) == len(promises) > 50
    for one in promises:
        file, _, test = one["test"].partition("::")
        tree = ast.parse((ROOT / file).read_text("utf-8"))
        assert test in [each.name for each in tree.body if isinstance(each, ast.FunctionDef)], one
