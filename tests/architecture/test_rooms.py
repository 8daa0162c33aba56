"""Sizes and names that keep the house readable."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest
import vulture

from tests.architecture.walk import ROOT, SOURCE

MODULES = sorted(SOURCE.rglob("*.py"))
FOLDERS = sorted({module.parent for module in MODULES})
BENCHMARKS = sorted((ROOT / "benchmarks").glob("*.py"))
MODULES_A_FOLDER, LINES_A_MODULE = 25, 500

# What nothing in src calls, and why it stays.
UNUSED = {
    "__getattr__": "Python calls it, for the public names that are loaded when they are asked for",
    "__dir__": "Python calls it, for `dir(dappled)`",
    "collect": "prometheus_client calls it",
}

# What may make a thread besides `workers.Loop`, and why.
THREADS = {
    "workers.py": "`Loop` is one, and `share` joins its helpers without a limit of time",
}


def name(path: Path) -> str:
    return str(path.relative_to(SOURCE))


@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_a_folder_can_be_overlooked(folder: Path) -> None:
    assert len(list(folder.glob("*.py"))) <= MODULES_A_FOLDER


def test_modules_are_of_a_size_to_be_read() -> None:
    lines = {name(module): len(module.read_text(encoding="utf-8").splitlines()) for module in MODULES}
    assert not {module: count for module, count in lines.items() if count > LINES_A_MODULE}


def test_a_class_name_means_one_thing() -> None:
    found = defaultdict(list)
    for module in MODULES:
        for node in ast.parse(module.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(name(module))
    assert not {title: places for title, places in found.items() if len(places) > 1}


def test_other_rooms_import_a_face_where_there_is_one() -> None:
    """What a room's `__init__` hands out is imported from there; and no private name or module leaves its room."""
    past, private = [], []
    for module in MODULES:
        own = module.relative_to(SOURCE).parent.parts
        for imported, title in _imports(module):
            place = f"{name(module)}: {'.'.join(imported)}.{title}"
            room = _room(imported)
            inside = own[: len(room)] == room or _room(own) == room[: len(own)]
            if not inside and (title.startswith("_") or any(part.startswith("_") for part in imported)):
                private.append(place)
            if not inside and imported != room and title in FACES.get(room, ()):
                past.append(place)
    assert past == []
    assert private == []


def test_nothing_is_there_for_tests_only() -> None:
    finder = vulture.Vulture()
    finder.scavenge([str(SOURCE)], exclude=[str(SOURCE / "testing")])
    kinds = ("function", "class", "method", "property")
    unused = {item.name for item in finder.get_unused_code() if item.typ in kinds}
    assert unused - set(UNUSED) == set()
    assert set(UNUSED) - unused == set(), "these are used by now: strike them from the list"


def test_threads_are_loops() -> None:
    """So that each has a name, an end, and a place in `dead_threads`."""
    made = {name(module) for module in MODULES if "Thread(" in _calls(module)}
    assert made - set(THREADS) == set()
    assert set(THREADS) - made == set(), "these make none by now: strike them from the list"


def _calls(module: Path) -> set[str]:
    """The last words of what a module calls: {"Thread(", "start(", …}."""
    called = [
        node.func for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)
    ]
    return {f"{ast.unparse(each).rpartition('.')[2]}(" for each in called}


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda path: path.stem)
def test_a_benchmark_calls_what_ships(benchmark: Path) -> None:
    """No benchmark assigns to an attribute of the product's modules, classes or objects."""
    tree = ast.parse(benchmark.read_text(encoding="utf-8"))
    imported = {
        (alias.asname or alias.name).split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    patched = [ast.unparse(node) for node in ast.walk(tree) if _patches(node, imported)]
    assert not patched


def _imports(module: Path) -> list[tuple[tuple[str, ...], str]]:
    """(module below dappled as a tuple, name) of each `from dappled… import name`."""
    return [
        (tuple(node.module.split(".")[1:]), alias.name)
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "dappled"
        for alias in node.names
    ]


def _room(parts: tuple[str, ...]) -> tuple[str, ...]:
    """The innermost folder in which a module of this name lies."""
    return parts if SOURCE.joinpath(*parts).is_dir() else parts[:-1]


def _face(folder: Path) -> tuple[str, ...]:
    for node in ast.parse((folder / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return tuple(ast.literal_eval(node.value))
    return ()


# The face of `drivers` is for third parties; the project itself imports the contract, `drivers.camera`.
FACES = {
    folder.relative_to(SOURCE).parts: _face(folder) for folder in FOLDERS if folder not in (SOURCE, SOURCE / "drivers")
}


def _patches(node: ast.AST, imported: set[str]) -> bool:
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return any(isinstance(target, ast.Attribute) and _root(target) in imported for target in targets)
    if not isinstance(node, ast.Call):
        return False
    called = node.func
    if not (isinstance(called, ast.Name) and called.id in {"setattr", "patch"}):
        return False
    return called.id == "patch" or _root(node.args[0]) in imported


def _root(node: ast.expr) -> str:
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""
