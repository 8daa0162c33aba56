"""Finding drivers by name."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import pytest

from dappled.config.schema import ConfigError
from dappled.config.settings import CameraSettings
from dappled.drivers import registry
from dappled.drivers.camera import CameraError
from dappled.drivers.gphoto2.client import GPhoto2Camera


def test_the_shipped_driver_is_found() -> None:
    assert isinstance(registry.open_camera(CameraSettings()), GPhoto2Camera)


def test_an_unknown_driver_is_named_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'canon'; installed: .*gphoto2"):
        registry.open_camera(CameraSettings(driver="canon"))


@pytest.mark.parametrize("value", ["no_such_module:open", "dappled.drivers.camera:no_such_name"])
def test_a_driver_that_can_t_be_loaded(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    def found(**_: Any) -> list[EntryPoint]:
        return [EntryPoint("broken", value, registry.GROUP)]

    monkeypatch.setattr(registry, "entry_points", found)
    with pytest.raises(CameraError, match="'broken' can't be loaded"):
        registry.open_camera(CameraSettings(driver="broken"))
