"""The driver `fujifilm`: FinePix S5200 and its relatives, which no USB command can fire.

A shutter line fires them, and their files are picked up. A shot can be decoded in flight only where its file can be
reached in flight.

`camera.shutter` is required (see `shutter_line`). `camera.pickup` is "later" (the default: `dappled flight pickup`
after landing), "storage" (a card or the body as USB mass storage, as soon as it is mounted), a libgphoto2 port such as
"usb:" (the body in PTP mode), or a folder that is filled in flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dappled.drivers.camera import CameraError, Identity, check_options, seconds_option, text_option
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.shutter_line import KINDS, hold_s
from dappled.drivers.wired.shutter_line import shutter as shutter_line
from dappled.drivers.wired.sources import FileSource, FolderSource, parse_source

BRING = "bring it with `dappled flight pickup` after landing"
_KNOWN = ("shutter", "pickup", "timeouts", "model", "hold_ms", "half_press", "half_press_ms")
_SLOW_POLL_S = 2.0


def open_camera(settings: Mapping[str, Any]) -> ComposedCamera:
    """Return the driver for these settings, not started. Raises CameraError for a wrong or a missing one."""
    check_options(settings, _KNOWN)
    shutter = text_option(settings, "shutter")
    if not shutter:
        raise CameraError(f"this camera can't be fired over USB: set camera.shutter to one of {KINDS}")
    pickup = text_option(settings, "pickup") or "later"
    source = None if pickup == "later" else parse_source(pickup, PtpSource)
    identity = Identity("FUJIFILM", text_option(settings, "model") or "FinePix S5200", "", shutter)
    follows = _follows(pickup, source)
    composed = ComposedSettings(
        file_s=seconds_option(settings, "file_s", 30.0),
        follows=follows,
        hold_s=hold_s(settings),
        poll_s=_SLOW_POLL_S if isinstance(source, PtpSource) else 0.2,
    )
    return ComposedCamera(identity, shutter_line(settings), source, composed)


def _follows(pickup: str, source: FileSource | None) -> str | None:
    if source is None:
        return f"it was fired; its file is on the camera's card: {BRING}"
    if type(source) is FolderSource:
        return None
    return f"it was fired; its file follows when {pickup} can be reached, or {BRING}"
