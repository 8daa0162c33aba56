"""A folder that any other program fills is a camera, too: what appears there after a shot is the shot's file.

`camera.pickup` names the folder. `camera.shutter` says how it is fired (see `shutter_line`); without one, who wishes
for a shot has fired it already: an autopilot on its mission, or the other program.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dappled.drivers.camera import CameraError, Identity, check_options, seconds_option, text_option
from dappled.drivers.wired.composed import ComposedCamera, Plan
from dappled.drivers.wired.shutter_line import hold_s, parse_line
from dappled.drivers.wired.sources import FolderSource

_KNOWN = ("shutter", "pickup", "timeouts", "model", "hold_ms")


def open_camera(settings: Mapping[str, Any]) -> ComposedCamera:
    """The driver for these settings; `start` it. Raises CameraError for a wrong or a missing one."""
    check_options(settings, _KNOWN)
    folder = text_option(settings, "pickup").removeprefix("folder:")
    if not folder:
        raise CameraError("which folder? set camera.pickup to the one that the other program fills")
    path = Path(folder).expanduser()
    if not path.is_dir():
        raise CameraError(f"camera.pickup = {folder!r} is no folder: make it, or correct the path")
    identity = Identity("folder", text_option(settings, "model") or path.name, "", str(path))
    plan = Plan(file_s=seconds_option(settings, "file_s", 30.0), hold_s=hold_s(settings))
    return ComposedCamera(identity, parse_line(text_option(settings, "shutter") or "outside"), FolderSource(path), plan)
