"""The settings of a camera that libgphoto2 drives, for the driver and its process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from dappled.drivers.camera import CameraError, check_options, seconds_option

CaptureTarget = Literal["card", "ram"]
NO_HOME = {"HOME": "/nonexistent", "TZ": "UTC0"}
"""For processes that load libgphoto2: it keeps settings (capture target, ...) under HOME, and would let one run change
the next. It reads a body's time as that of this time zone where a file is announced, and as UTC where it is listed."""


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Waiting times in seconds; all above 0.

    `busy_s`: for a busy camera to accept the release. `complete_s`: for the file after the camera has reported that the
    capture is complete, before its card is searched. `look_s`: the same where it reported nothing. `file_s`: for the
    file, from the release, before the shot has failed. `answer_s`: for the camera's process to answer, before it is
    killed (libgphoto2 needs up to 10 s to give up on a silent camera). `retry_s`: between attempts to find the camera.
    """

    busy_s: float = 5.0
    complete_s: float = 2.5
    look_s: float = 10.0
    file_s: float = 20.0
    answer_s: float = 12.0
    retry_s: float = 1.0


@dataclass(frozen=True, slots=True)
class GPhoto2Settings:
    """Which camera to open, and how to use it.

    `port`: a libgphoto2 port; None or "usb:" is the first camera on USB. `serial`: only the body with this number; None
    accepts any. `capture_target`: where the body stores its pictures; with "card" a file survives a broken link.
    `delete_after_download`: delete from the card what the receiver has released.
    """

    port: str | None = None
    serial: str | None = None
    capture_target: CaptureTarget = "card"
    delete_after_download: bool = False
    timeouts: Timeouts = field(default_factory=Timeouts)


def parse_settings(settings: Mapping[str, Any]) -> GPhoto2Settings:
    """Parse a table of a configuration file. Raises CameraError naming the key and what it may be."""
    known = [each.name for each in fields(GPhoto2Settings)]
    check_options(settings, known)
    port, serial = settings.get("port"), settings.get("serial")
    for name, value in (("port", port), ("serial", serial)):
        if not (value is None or isinstance(value, str)):
            raise CameraError(f"camera.{name} must be text, not {value!r}")
    target = settings.get("capture_target", "card")
    if target not in ("card", "ram"):
        raise CameraError(f'camera.capture_target must be "card" or "ram", not {target!r}')
    delete = settings.get("delete_after_download", False)
    if not isinstance(delete, bool):
        raise CameraError(f"camera.delete_after_download must be true or false, not {delete!r}")
    return GPhoto2Settings(port or None, serial or None, target, delete, _timeouts(settings.get("timeouts", {})))


def _timeouts(given: object) -> Timeouts:
    if not isinstance(given, Mapping):
        raise CameraError(f"camera.timeouts must be a table, not {given!r}")
    check_options(given, [each.name for each in fields(Timeouts)], "camera.timeouts")
    return Timeouts(**{name: seconds_option({"timeouts": given}, name, 0.0) for name in given})
