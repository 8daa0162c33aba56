"""The driver of docs/drivers.md does what the page says, as it stands there."""

from __future__ import annotations

import re
import sys
import types
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from dappled.config.settings import CameraSettings
from dappled.daemon import cameras
from dappled.mocks.body.body import pattern
from tests.drivers.contract import CameraContract, Rig

PAGE = Path(__file__).parents[2] / "docs" / "drivers.md"


def code() -> str:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return str(block)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's driver, installed as the page says."""
    module = types.ModuleType("your_package.camera")
    exec(compile(code(), str(PAGE), "exec"), module.__dict__)  # noqa: S102  # the page is ours
    monkeypatch.setitem(sys.modules, "your_package", types.ModuleType("your_package"))
    monkeypatch.setitem(sys.modules, "your_package.camera", module)

    def found(**_: Any) -> list[EntryPoint]:
        return [EntryPoint("command", "your_package.camera:open_camera", cameras.GROUP)]

    monkeypatch.setattr(cameras, "entry_points", found)


@pytest.fixture
def command(tmp_path: Path) -> Path:
    """A command that writes the n-th picture, whole."""
    for number in range(1, 6):
        (tmp_path / f"{number}.picture").write_bytes(pattern(number, 20_000))
    script = tmp_path / "shoot"
    script.write_text(
        "#!/bin/sh\n"
        'number=$(basename "$1" .dng | sed "s/shot_0*//")\n'
        f'cp "{tmp_path}/$number.picture" "$1.part" && mv "$1.part" "$1"\n'
    )
    script.chmod(0o755)
    return script


@pytest.mark.usefixtures("driver")
class TestContractOfThePage(CameraContract):
    @pytest.fixture
    def rig(self, driver: None, command: Path) -> Iterator[Rig]:
        camera = cameras.open_camera(CameraSettings(driver="command", options={"command": str(command)}))
        yield Rig(camera, lambda number: pattern(number, 20_000), loose=True)
        camera.stop()


def test_it_is_short() -> None:
    lines = [line for line in code().splitlines() if line.strip()]
    assert len(lines) <= 40
