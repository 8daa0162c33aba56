"""Find a camera driver by name among the entry points of all installed packages, and open it."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from dappled.config.schema import ConfigError
from dappled.config.settings import CameraSettings
from dappled.drivers.camera import Camera, CameraError

GROUP = "dappled.cameras"


def open_camera(settings: CameraSettings) -> Camera:
    """Open the configured driver; `start` it afterwards. Raises ConfigError where no package provides one of that name,
    and CameraError where it can't be loaded."""
    found = {entry.name: entry for entry in entry_points(group=GROUP)}
    entry = found.get(settings.driver)
    if entry is None:
        raise ConfigError(f"there is no camera driver named {settings.driver!r}; installed: {', '.join(sorted(found))}")
    options = _options(settings)
    try:
        make = entry.load()
    except (ImportError, AttributeError) as error:
        raise CameraError(
            f"the camera driver {settings.driver!r} can't be loaded ({error}); install it again"
        ) from None
    camera: Camera = make(options)
    return camera


def _options(settings: CameraSettings) -> dict[str, Any]:
    """Return the options for a driver: the file's time-out, and every other setting that was set. A driver
    refuses options that it doesn't know, so that no setting is silently ignored."""
    common = {
        "port": settings.port,
        "serial": settings.serial,
        "capture_target": "" if settings.capture_target == "card" else settings.capture_target,
        "delete_after_download": settings.delete_after_download,
        "shutter": settings.shutter,
        "pickup": settings.pickup,
    }
    given = {name: value for name, value in common.items() if value}
    return {"timeouts": {"file_s": settings.file_timeout_s}, **given, **(settings.options or {})}
