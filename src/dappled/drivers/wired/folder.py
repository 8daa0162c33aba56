"""The driver `folder`: a camera whose files another program writes to a folder.

`camera.pickup` names the folder. A file that appears there after a shot is the shot's file. `camera.shutter` says how
the camera is fired (see `shutter_line`). Without it, something else has fired the camera when a shot is requested: an
autopilot on its mission, or the other program.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dappled.drivers.camera import CameraError, Identity, check_options, seconds_option, text_option
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.shutter_line import hold_s, shutter
from dappled.drivers.wired.sources import FolderSource

_PICKUP = "camera.pickup"
_KNOWN = ("shutter", "pickup", "timeouts", "model", "hold_ms", "half_press", "half_press_ms")


def open_camera(settings: Mapping[str, Any]) -> ComposedCamera:
    """Return the driver for these settings, not started. Raises CameraError for a wrong or a missing one."""
    check_options(settings, _KNOWN)
    folder = text_option(settings, "pickup").removeprefix("folder:")
    if not folder:
        raise CameraError("camera.pickup is not set: name the folder that the other program writes to", setting=_PICKUP)
    path = Path(folder).expanduser()
    if not path.is_dir():
        raise CameraError(f"camera.pickup = {folder!r} is not a folder: make it, or correct the path", setting=_PICKUP)
    identity = Identity("folder", text_option(settings, "model") or path.name, "", str(path))
    composed = ComposedSettings(file_s=seconds_option(settings, "file_s", 30.0), hold_s=hold_s(settings))
    return ComposedCamera(identity, shutter(settings, "outside"), FolderSource(path), composed)
