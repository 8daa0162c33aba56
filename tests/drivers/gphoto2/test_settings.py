from __future__ import annotations

from typing import Any

import pytest

from dappled import codec
from dappled.drivers.camera import CameraError
from dappled.drivers.gphoto2.settings import GPhoto2Settings, Timeouts, parse_settings


def test_an_empty_table_is_a_working_camera() -> None:
    assert parse_settings({}) == GPhoto2Settings()
    assert parse_settings({"port": "", "serial": ""}) == GPhoto2Settings()


def test_settings_survive_encoding() -> None:
    settings = GPhoto2Settings("usb:", "123", "ram", True, Timeouts(busy_s=1.5))
    assert parse_settings(codec.plain(settings)) == settings


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"prot": "usb:"}, ["prot", "port"]),
        ({"port": 5}, ["camera.port", "5"]),
        ({"serial": 830412345}, ["camera.serial", "830412345"]),
        ({"capture_target": "disk"}, ["disk", "card", "ram"]),
        ({"delete_after_download": "no"}, ["delete_after_download", "no"]),
        ({"timeouts": 5}, ["camera.timeouts", "5"]),
        ({"timeouts": {"file": 5}}, ["camera.timeouts", "file", "file_s"]),
        ({"timeouts": {"file_s": 0}}, ["camera.timeouts.file_s", "0"]),
        ({"timeouts": {"file_s": True}}, ["camera.timeouts.file_s", "True"]),
        ({"timeouts": {"file_s": float("nan")}}, ["camera.timeouts.file_s", "nan"]),
    ],
)
def test_a_wrong_setting_is_named(settings: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(CameraError) as caught:
        parse_settings(settings)
    for word in words:
        assert word in str(caught.value)
