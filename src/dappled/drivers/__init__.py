"""The hardware edge: cameras, the MAVLink link, raw files.

`__all__` is the public face for drivers of your own, see `docs/api.md`. It is loaded when it is first used: the
camera's process and the command line import modules of this package that need none of it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dappled.clock import Clock
    from dappled.drivers.camera import (
        Arrival,
        Blob,
        BodyState,
        Camera,
        CameraError,
        CameraEvent,
        Companion,
        Deferred,
        Fired,
        Identity,
        PlainCamera,
        QueuedCamera,
        Setting,
        SettingName,
        SettingsChanged,
        ShotFailed,
        StateChanged,
        check_change,
        check_options,
        seconds_option,
        text_option,
    )
    from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
    from dappled.drivers.wired.shutter_line import CommandSender, ShutterLine, UsesAutopilot
    from dappled.drivers.wired.sources import FileSource, FolderSource, FoundFile

__all__ = [
    "Arrival",
    "Blob",
    "BodyState",
    "Camera",
    "CameraError",
    "CameraEvent",
    "Clock",
    "CommandSender",
    "Companion",
    "ComposedCamera",
    "ComposedSettings",
    "Deferred",
    "FileSource",
    "Fired",
    "FolderSource",
    "FoundFile",
    "Identity",
    "PlainCamera",
    "QueuedCamera",
    "Setting",
    "SettingName",
    "SettingsChanged",
    "ShotFailed",
    "ShutterLine",
    "StateChanged",
    "UsesAutopilot",
    "check_change",
    "check_options",
    "seconds_option",
    "text_option",
]

_ELSEWHERE = {  # all others are in `camera`
    "Clock": "dappled.clock",
    "CommandSender": "dappled.drivers.wired.shutter_line",
    "ComposedCamera": "dappled.drivers.wired.composed",
    "ComposedSettings": "dappled.drivers.wired.composed",
    "FileSource": "dappled.drivers.wired.sources",
    "FolderSource": "dappled.drivers.wired.sources",
    "FoundFile": "dappled.drivers.wired.sources",
    "ShutterLine": "dappled.drivers.wired.shutter_line",
    "UsesAutopilot": "dappled.drivers.wired.shutter_line",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name in __all__:
        return getattr(import_module(_ELSEWHERE.get(name, "dappled.drivers.camera")), name)
    raise AttributeError(f"module 'dappled.drivers' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
