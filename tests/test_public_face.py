"""The public face is what docs/api.md says, costs little to import, and is all that documents and examples use."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FunctionType, UnionType
from typing import Any, Literal, Union, get_origin

import pytest

import dappled
import dappled.errors
import dappled.typing

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "api.md"
PUBLIC = ("dappled", "dappled.drivers", "dappled.errors", "dappled.testing", "dappled.typing")

TYPED = """
import dappled
from dappled.errors import DappledError
from dappled.typing import Message, OpenedLightField


def handle(message: Message) -> None:
    print(message.topic, message.arrays())


async def listen() -> None:
    async for message in dappled.subscribe("ipc:///run/dappled/slices", topics=["slices"]):
        handle(message)


def main(camera: dappled.Camera) -> str:
    camera.fire(1)
    try:
        found = dappled.open("frame.zarr")
    except DappledError:
        return dappled.__version__
    if isinstance(found, OpenedLightField):
        print(found.refocus(alpha=1.0).shape)
    print(dappled.open("frame.cr2", kind="frame", mask="mask-2").plot("spectrum").get_title())
    stream = dappled.subscribe("tcp://10.0.0.7:5555", keys="laptop.key_secret", server_key="vehicle.key")
    for message in stream:
        handle(message)
    return f"{stream.lost} lost"
"""


def test_dir_shows_the_face_alone() -> None:
    assert dir(dappled) == ["Camera", "__version__", "open", "subscribe"]
    for name in dir(dappled):
        assert getattr(dappled, name)
    with pytest.raises(AttributeError, match="no attribute 'opne'"):
        getattr(dappled, "opne")  # noqa: B009  # mypy knows that there is none


@pytest.mark.parametrize("module", ["dappled", "dappled.drivers"])
def test_importing_loads_nothing_else(module: str) -> None:
    code = f"import sys, {module}; print(*[one for one in sys.modules if one.startswith(('dappled.', 'numpy', 'zmq'))])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == [name for name in [module] if name != "dappled"]


@pytest.mark.parametrize("module", ["dappled", "dappled.drivers", "dappled.testing", "dappled.typing"])
def test_every_public_name_is_there_and_in_the_page(module: str) -> None:
    found = importlib.import_module(module)
    page = PAGE.read_text(encoding="utf-8")
    for name in found.__all__:
        assert getattr(found, name) is not None
        assert re.search(rf"`[^`]*\b{name}\b[^`]*`", page), name


def public() -> dict[str, object]:
    """What the public modules hand out, by name."""
    modules = [importlib.import_module(name) for name in PUBLIC if name != "dappled.errors"]
    return {name: getattr(module, name) for module in modules for name in module.__all__} | {
        "DappledError": dappled.errors.DappledError
    }


def promised(name: str, value: object) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """(where, annotations, the names that these use) of a public function, or of a public class' promised attributes.

    Of what is opened, the page names the attributes; of all other classes everything public is promised.
    """
    if isinstance(value, FunctionType):
        yield name, inspect.get_annotations(value), value.__globals__
    if not isinstance(value, type):
        return
    spans = re.findall(r"`([^`\n]+)`", PAGE.read_text(encoding="utf-8")) if name in dappled.typing.__all__ else []
    listed = {
        word for span in spans for word in re.findall(r"\w+", re.sub(r'"[^"]*"', "", span))
    }  # not words in quotes
    for kind in value.__mro__:
        if not kind.__module__.startswith("dappled."):
            continue
        space = vars(importlib.import_module(kind.__module__))
        fields = {f"{name}.{one}": {one: text} for one, text in inspect.get_annotations(kind).items()}
        calls = {f"{name}.{one}": inspect.get_annotations(call) for one, call in functions(kind)}
        for where, texts in (fields | calls).items():
            attribute = where.rpartition(".")[2]
            special = attribute in ("__iter__", "__aiter__", "__getitem__", *([] if listed else ["__init__"]))
            on_page = not listed or attribute in listed
            if special or (on_page and not attribute.startswith("_")):
                yield where, texts, space


def functions(kind: type) -> Iterator[tuple[str, FunctionType]]:
    for name, value in vars(kind).items():
        call = getattr(value, "fget", None) or getattr(value, "func", None) or getattr(value, "__func__", value)
        if isinstance(call, FunctionType):
            yield name, call


def private(annotation: str, space: Mapping[str, Any], known: Mapping[str, object]) -> Iterator[str]:
    """The classes of dappled in an annotation, and its names for unions, words and signatures, that are not public."""
    for node in ast.walk(ast.parse(annotation, mode="eval")):
        if isinstance(node, ast.Name) and node.id in space and node.id not in known:
            value = space[node.id]
            ours = isinstance(value, type) and value.__module__.startswith("dappled.")
            if ours or get_origin(value) in (Literal, Union, UnionType, Callable):
                yield node.id


def test_every_type_that_is_taken_or_returned_is_public() -> None:
    known = public()
    missing = {
        f"{where}: {name}"
        for one, value in known.items()
        for where, texts, space in promised(one, value)
        for text in texts.values()
        if isinstance(text, str)
        for name in private(text, space, known)
    }
    assert missing == set()


def documented(page: str) -> str:
    """The programs of a page that use dappled, one after the other."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return "\n".join(block for block in blocks if "import dappled\n" in block)


@pytest.mark.slow
def test_a_typed_program_and_the_documented_ones_pass_mypy_strict(tmp_path: Path, types_cache: Path) -> None:
    programs = {"program.py": TYPED, **{f"{page}.py": documented(f"{page}.md") for page in ("api", "products")}}
    for name, text in programs.items():
        assert "dappled.open(" in text
        (tmp_path / name).write_text(text, encoding="utf-8")
    words = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(types_cache), *sorted(programs)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=110, check=False)
    assert "no issues found" in done.stdout, done.stdout + done.stderr


def imported(code: str) -> Iterator[str]:
    """The modules of dappled that a program imports, `from dappled import x` as dappled.x where x is a module."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            if node.module == "dappled":
                yield from (f"dappled.{alias.name}" for alias in node.names if alias.name not in dir(dappled))


def programs() -> list[tuple[str, str]]:
    """(where it stands, code) of all Python in documents and examples."""
    found = [(path.name, path.read_text(encoding="utf-8")) for path in (ROOT / "examples").rglob("*.py")]
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        found += [(page.name, block) for block in blocks]
    for path in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        lines = "".join("".join([*cell["source"], "\n"]) for cell in cells if cell["cell_type"] == "code").splitlines()
        plain = (
            line for line in lines if re.match(r"import |from ", line)
        )  # the rest holds commands and file contents
        found.append((path.name, "\n".join(plain)))
    return found


def test_documents_and_examples_import_the_public_face_alone() -> None:
    pages = set()
    for where, code in programs():
        for module in imported(code):
            if module.split(".")[0] == "dappled":
                assert module in PUBLIC, f"{where} imports {module}"
                pages.add(where)
    assert {"drivers.md", "products.md", "wire.md", "first-light-field.ipynb"} <= pages
