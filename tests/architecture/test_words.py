"""What was found is a value: no code reads the words of a finding back, and no field holds a doubt as words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from tests.architecture.walk import SOURCE, parsed

RENDERERS = ("text", "told")
# What a module that may do such a thing has in it: the others are not parsed and walked for it.
RENDERS = re.compile(rf"(import ([^\n(]*|\([^)]*)\b|findings\.)({'|'.join(RENDERERS)})\b")
DOUBTS = re.compile(r"doubts?_*\s*:")
MODULES = sorted(path for path in SOURCE.rglob("*.py") if path.name != "findings.py")


def _renders(node: ast.AST, names: set[str]) -> bool:
    """Whether an expression is the words of a finding: a renderer's call, or a name that holds one's answer."""
    if isinstance(node, ast.Call):
        called = node.func
        if isinstance(called, ast.Attribute):
            return called.attr in RENDERERS and ast.unparse(called.value) == "findings"
        return isinstance(called, ast.Name) and called.id in names
    return isinstance(node, ast.Name) and f"={node.id}" in names


def read_back(source: str) -> set[str]:
    """The places where words of a finding are compared, searched, cut or split."""
    found = set[str]()
    if not RENDERS.search(source):
        return found
    tree = parsed(source)
    imported = {
        one.asname or one.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "dappled.findings"
        for one in node.names
        if one.name in RENDERERS
    }
    for scope in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.Module)):
        names = set(imported)
        inside = list(ast.walk(scope))
        if isinstance(scope, ast.FunctionDef):
            for node in inside:
                if isinstance(node, ast.Assign | ast.NamedExpr) and _renders(node.value, names):
                    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                    names |= {f"={one.id}" for one in targets if isinstance(one, ast.Name)}
        for node in inside:
            parts = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
            parts += [node.value] if isinstance(node, ast.Attribute | ast.Subscript) else []
            if any(_renders(part, names) for part in parts):
                found.add(f"line {getattr(node, 'lineno', 0)}: {ast.unparse(node)}")
    return found


def worded_doubts(source: str) -> Iterator[str]:
    """The fields and arguments that hold doubts as words."""
    for node in ast.walk(parsed(source)) if DOUBTS.search(source) else ():
        title = ""
        if isinstance(node, ast.AnnAssign):
            title, annotation = ast.unparse(node.target).removeprefix("self."), ast.unparse(node.annotation)
        elif isinstance(node, ast.arg) and node.annotation is not None:
            title, annotation = node.arg, ast.unparse(node.annotation)
        if title.strip("_").endswith(("doubt", "doubts")) and "str" in annotation:
            yield f"line {getattr(node, 'lineno', 0)}: {title}: {annotation}"


@pytest.mark.parametrize(
    "source",
    [
        "from dappled.findings import told\ndef f(a):\n    return 'full' in told(a)",
        "from dappled.findings import text as words\ndef f(a):\n    return words(a).split(':')",
        "from dappled import findings\ndef f(a):\n    said = findings.told(a)\n    return said == 'the disk is full'",
        "from dappled import findings\ndef f(a):\n    return findings.text(a)[:5]",
    ],
)
def test_words_that_are_read_back_are_seen(source: str) -> None:
    assert len(read_back(source)) == 1


def test_no_words_of_a_finding_are_read_back() -> None:
    found = {str(path.relative_to(SOURCE)): read_back(path.read_text("utf-8")) for path in MODULES}
    assert not {path: places for path, places in found.items() if places}


def test_no_field_holds_a_doubt_as_words() -> None:
    found = {str(path.relative_to(SOURCE)): list(worded_doubts(path.read_text("utf-8"))) for path in MODULES}
    assert not {path: places for path, places in found.items() if places}
    assert list(worded_doubts("class A:\n    doubts: tuple[str, ...] = ()"))
