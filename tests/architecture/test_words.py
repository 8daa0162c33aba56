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
MAKERS = ("finding", "with_facts", "_one")
MAKES = re.compile(rf"\b({'|'.join(MAKERS)})\(")
WORDERS = ("sentence", "first_line", "told", "named", "remedy", "text")
ERRORS = re.compile(rf"error|exception|({'|'.join(WORDERS)})\(")
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


def worded_facts(source: str) -> Iterator[str]:
    """The facts that are sentences: words of an error or a finding, or four words and more."""
    for node in ast.walk(parsed(source)) if MAKES.search(source) else ():
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in MAKERS:
            for fact in node.keywords:
                if any(map(_worded, _choices(fact.value))):
                    yield f"line {fact.value.lineno}: {fact.arg}={ast.unparse(fact.value)}"


def _choices(value: ast.expr) -> Iterator[ast.expr]:
    """What an expression may be, one way or another."""
    if isinstance(value, ast.IfExp | ast.BoolOp):
        for one in value.values if isinstance(value, ast.BoolOp) else (value.body, value.orelse):
            yield from _choices(one)
    else:
        yield value


def _worded(value: ast.expr) -> bool:
    if isinstance(value, ast.Call):
        name, given = ast.unparse(value.func).rpartition(".")[2], ast.unparse(value).partition("(")[2]
        return name in WORDERS or (name in {"str", "repr"} and ERRORS.search(given) is not None)
    if isinstance(value, ast.Attribute):
        return value.attr in {"sentence", "strerror", "words"}
    parts = value.values if isinstance(value, ast.JoinedStr) else [value]
    said = " x ".join(str(one.value) if isinstance(one, ast.Constant) else "" for one in parts)
    return isinstance(value, ast.JoinedStr | ast.Constant) and len(said.split()) > 3


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


@pytest.mark.parametrize(
    "fact",
    [
        "str(error)",
        "str(text(found))",
        "sentence(error) if error else None",
        "found and findings.text(found)",
        "decision.sentence",
        "'decoding was switched off'",
        "f'the telemetry is {age_s} s old'",
    ],
)
def test_facts_that_are_sentences_are_seen(fact: str) -> None:
    assert len(list(worded_facts(f"finding(Code.A, FRAME, path=path, why={fact})"))) == 1


def test_no_fact_is_a_sentence() -> None:
    found = {str(path.relative_to(SOURCE)): list(worded_facts(path.read_text("utf-8"))) for path in MODULES}
    assert not {path: places for path, places in found.items() if places}


def test_no_field_holds_a_doubt_as_words() -> None:
    found = {str(path.relative_to(SOURCE)): list(worded_doubts(path.read_text("utf-8"))) for path in MODULES}
    assert not {path: places for path, places in found.items() if places}
    assert list(worded_doubts("class A:\n    doubts: tuple[str, ...] = ()"))
