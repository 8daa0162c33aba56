"""The driver of docs/drivers.md, in a package of its own: found by name, typed, and passing the tests of the page."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dappled.config.settings import CameraSettings
from dappled.drivers import registry
from dappled.testing import CameraContract

PAGE = Path(__file__).parents[2] / "docs" / "drivers.md"


def code() -> tuple[str, str]:
    """The page's driver, and its tests."""
    driver, tests = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return driver, tests


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with the package as pip installs it, its entry point as the page has it, and its tests."""
    driver, tests = code()
    (entry_points,) = re.findall(
        r'\[project\.entry-points\."(dappled\.cameras)"\]\n(command) = "(.*)"', PAGE.read_text(encoding="utf-8")
    )
    folder = tmp_path / "site"
    facts = folder / "your_package-1.0.dist-info"
    for made in (folder / "your_package", facts):
        made.mkdir(parents=True)
    (folder / "your_package" / "__init__.py").touch()
    (folder / "your_package" / "py.typed").touch()
    (folder / "your_package" / "camera.py").write_text(driver, encoding="utf-8")
    (folder / "test_camera.py").write_text(tests, encoding="utf-8")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: your-package\nVersion: 1.0\n")
    group, name, target = entry_points
    (facts / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
    return folder


def run(package: Path, *words: str) -> str:
    """What a Python module prints where the package is installed. Fails unless it exits with 0."""
    paths = os.pathsep.join([str(package), *(path for path in sys.path if path)])
    done = subprocess.run(
        [sys.executable, "-m", *words],
        cwd=package,
        env={**os.environ, "PYTHONPATH": paths, "MYPYPATH": ""},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_its_own_tests_pass_with_public_imports_alone(package: Path) -> None:
    count = sum(name.startswith("test_") for name in dir(CameraContract))
    printed = run(package, "pytest", "-q", "-p", "no:cacheprovider", "test_camera.py")
    assert f"{count} passed" in printed


@pytest.mark.slow
def test_it_is_typed(package: Path, types_cache: Path) -> None:
    printed = run(package, "mypy", "--strict", "--cache-dir", str(types_cache), "your_package", "test_camera.py")
    assert "no issues found in 3 source files" in printed


def test_it_is_found_by_name(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(package)
    camera = registry.open_camera(CameraSettings(driver="command", options={"command": "true"}))
    assert type(camera).__name__ == "ComposedCamera"


def test_it_is_short() -> None:
    lines = [line for line in code()[0].splitlines() if line.strip()]
    assert len(lines) <= 40
