"""MAVSDK as a ground station: does what a user does, and writes what it saw as JSON.

python mavsdk_client.py PORT OUT
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mavsdk
from mavsdk.plugins.camera.camera import Camera, CameraError, Mode, Option, PhotosRange, Setting

CAMERA = 100
PATIENCE_S = 30.0
SETTINGS = {"CAM_ISO", "CAM_APERTURE", "CAM_SHUTTERSPD", "CAM_FORMAT", "LF_MASK", "LF_LAW", "LF_DECODE"}


def eventually(found: Callable[[], Any], what: str) -> Any:
    """The first true value that `found` gives; it may raise CameraError meanwhile."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        try:
            if value := found():
                return value
        except CameraError:
            pass
        time.sleep(0.05)
    raise SystemExit(f"never: {what}")


def result(act: Callable[[], Any]) -> str:
    """How MAVSDK says that a call ended."""
    try:
        return str(act().name)
    except CameraError as error:
        return str(error.result.name)


def quiet(heard: list[Any]) -> None:
    """Wait until nothing was heard for three seconds."""
    known, since = len(heard), time.monotonic()
    while time.monotonic() < since + 3.0:
        if len(heard) != known:
            known, since = len(heard), time.monotonic()
        time.sleep(0.05)


def all_settings(camera: Camera) -> dict[str, str] | None:
    """What each setting is; None until the values, which come one by one, are complete."""
    known = {one.setting_id: one.option.option_description for one in camera.get_current_settings(CAMERA)}
    return known if known.keys() >= SETTINGS else None


def main(port: str, out: str) -> None:
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION))
    sdk.add_any_connection(f"udpout://127.0.0.1:{port}")
    system = eventually(lambda: next((one for one in sdk.get_systems() if one.has_camera()), None), "a camera")
    camera = Camera(system)
    heard: list[Any] = []
    camera.subscribe_capture_info(lambda info, _: heard.append(info))
    (found,) = eventually(lambda: camera.camera_list().cameras, "its information")
    said: dict[str, Any] = {"vendor": found.vendor_name, "model": found.model_name}
    said["resolution"] = [found.horizontal_resolution_px, found.vertical_resolution_px]
    said["settings"] = eventually(lambda: all_settings(camera), "its settings")
    offered = eventually(lambda: camera.get_possible_setting_options(CAMERA), "its choices")
    said["iso choices"] = [o.option_description for s in offered if s.setting_id == "CAM_ISO" for o in s.options]
    said["set iso"] = result(lambda: camera.set_setting(CAMERA, Setting("CAM_ISO", "", Option("200", ""), False)))
    said["storage"] = eventually(lambda: camera.get_storage(CAMERA), "its storage").storage_status.name

    before = len(heard)
    said["photo"] = result(lambda: camera.take_photo(CAMERA))
    eventually(lambda: len(heard) > before, "the photo")
    said["photo info"] = [heard[before].index, heard[before].is_success, heard[before].file_url]
    before = len(heard)
    said["interval"] = result(lambda: camera.start_photo_interval(CAMERA, 0.5))
    eventually(lambda: len(heard) >= before + 3, "three photos of the interval")
    said["stop"] = result(lambda: camera.stop_photo_interval(CAMERA))
    said["mode"] = result(lambda: camera.set_mode(CAMERA, Mode.PHOTO))
    said["mode now"] = eventually(lambda: camera.get_mode(CAMERA), "its mode").name
    said["video mode"] = result(lambda: camera.set_mode(CAMERA, Mode.VIDEO))
    said["format"] = result(lambda: camera.format_storage(CAMERA, 1))
    said["zoom"] = result(lambda: camera.zoom_range(CAMERA, 50.0))
    said["reset"] = result(lambda: camera.reset_settings(CAMERA))
    quiet(heard)  # a shot of the interval may still be on its way; none may follow
    said["heard"] = [[one.index, one.is_success] for one in heard]
    eventually(lambda: len(camera.list_photos(CAMERA, PhotosRange.ALL)) > max(one.index for one in heard), "all photos")
    photos = camera.list_photos(CAMERA, PhotosRange.ALL)
    said["photos"] = [[one.index, one.is_success, one.file_url] for one in photos]
    Path(out).write_text(json.dumps(said), encoding="utf-8")


main(*sys.argv[1:])
sys.stdout.flush()
os._exit(0)  # MAVSDK's threads are not waited for
