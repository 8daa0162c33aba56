"""No test reaches into a private name of another room than its own: it would break with each rebuilding there."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.architecture.walk import ROOT, SOURCE, parsed

TESTS = ROOT / "tests"
PYTHONS = ("_replace", "_asdict", "_fields", "_make", "_exit")  # public, for all that they begin with
PUBLIC = "|".join(one.removeprefix("_") for one in PYTHONS)
# What a file that reaches anywhere has in it: the others are not parsed and walked.
AT_ALL = re.compile(
    rf"(?<!self)(?<!cls)\._(?!({PUBLIC})\b)[a-z]|import ([^\n(]*|\([^)]*)\b_[a-z]|attr\([^)]*[\"'.]_[a-z]",
    re.IGNORECASE,
)
PATCHES = ("setattr", "getattr", "delattr", "hasattr")


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in PYTHONS


def reached(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """(line, name) of each private name of something else than `self`."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Attribute):
            itself = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            names = [] if itself else [node.attr]
        elif isinstance(node, ast.ImportFrom):
            names = [one.name for one in node.names]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in PATCHES:
            words = [one.value for one in node.args[:2] if isinstance(one, ast.Constant)]
            names = [word.rpartition(".")[2] for word in words if isinstance(word, str)]
        yield from ((node.lineno, name) for name in names if private(name))  # type: ignore[attr-defined]


@cache
def homes() -> dict[str, set[Path]]:
    """Where each private name is at home, as a path below `src/dappled`; of the tests' own helpers, below `tests`."""
    found: dict[str, set[Path]] = defaultdict(set)
    for root, pattern in ((SOURCE, r"\b(_[a-z]\w*)"), (TESTS, r"(?:self\.|def |class )(_[a-z]\w*)")):
        for module in root.rglob("*.py"):
            for name in filter(private, re.findall(pattern, module.read_text(encoding="utf-8"), re.IGNORECASE)):
                found[name].add(module.relative_to(root))
    return found


def others(test: Path, text: str) -> list[str]:
    """The reaches of one file of tests into rooms that are not its own; a name that its room has too counts as its
    own, and one that nobody here defines is a library's."""
    room = test.parent

    def own(home: Path) -> bool:
        if room == Path():  # beside the rooms: of the module, or the room, of this name
            return home == test or home.parts[0].removesuffix(".py") == test.stem.removeprefix("test_")
        return home.is_relative_to(room)

    return [
        f"{test}:{line} {name}"
        for line, name in reached(parsed(text))
        if homes().get(name) and not any(map(own, homes()[name]))
    ]


def test_tests_reach_into_no_other_room() -> None:
    texts = ((path.relative_to(TESTS), path.read_text(encoding="utf-8")) for path in sorted(TESTS.rglob("*.py")))
    assert [reach for path, text in texts if AT_ALL.search(text) for reach in others(path, text)] == []


@pytest.mark.parametrize(
    "line",
    [
        "service._publish_health()",
        "from dappled.daemon.service import _LOOK_S",
        "monkeypatch.setattr(service, '_publish_health', None)",
        "monkeypatch.setattr('dappled.daemon.service._LOOK_S', 1)",
    ],
)
def test_a_reach_is_seen(line: str) -> None:
    assert others(Path("products/test_some.py"), line)
    assert not others(Path("daemon/test_service.py"), line)
