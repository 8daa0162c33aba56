"""The public face is what docs/api.md says, costs little to import, and is all that documents and examples use."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import dappled

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


@pytest.mark.slow
def test_a_typed_program_passes_mypy_strict(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(TYPED, encoding="utf-8")
    words = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), str(program)]
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
    return found


def test_documents_and_examples_import_the_public_face_alone() -> None:
    pages = set()
    for where, code in programs():
        for module in imported(code):
            if module.split(".")[0] == "dappled":
                assert module in PUBLIC, f"{where} imports {module}"
                pages.add(where)
    assert {"drivers.md", "products.md", "wire.md"} <= pages
