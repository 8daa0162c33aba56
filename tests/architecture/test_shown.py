"""One renderer of what others wrote: nothing prints but `shown.say`, so that no place can forget a name's escapes."""

from __future__ import annotations

import ast
import re

from tests.architecture.walk import SOURCE, parsed

OWN = {"shown.py"}
PRINTS = re.compile(r"\bprint\(|std(out|err)\.write")  # without it a module is not walked
ANSWERS = {"drivers/reader_process.py"}  # JSON to the process that started it


def printing(source: str) -> list[str]:
    """The calls that print, or write to a standard stream."""
    nodes = ast.walk(parsed(source)) if PRINTS.search(source) else ()
    called = [node.func for node in nodes if isinstance(node, ast.Call)]
    names = [ast.unparse(one) for one in called]
    return [one for one in names if one == "print" or one.removeprefix("sys.") in ("stdout.write", "stderr.write")]


def test_calls_that_print_are_seen() -> None:
    assert len(printing("print(1)\nsys.stdout.write('a')\nstderr.write('b')\nsay('c')")) == 3


def test_nothing_prints_but_the_renderer() -> None:
    modules = {path.relative_to(SOURCE).as_posix(): path for path in SOURCE.rglob("*.py")}
    found = {name: printing(path.read_text("utf-8")) for name, path in modules.items() if not name.startswith("mocks/")}
    assert {name for name, calls in found.items() if calls} == OWN | ANSWERS
