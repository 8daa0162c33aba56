"""Camera drivers are found by name, so that a third party's camera comes in by the same door as ours."""

from __future__ import annotations

from importlib.metadata import entry_points

from dappled.config.settings import CameraSettings
from dappled.drivers.camera import Camera, CameraError

GROUP = "dappled.cameras"


def open_camera(settings: CameraSettings) -> Camera:
    """The configured driver, not started yet. Raises CameraError where no package brings one of that name."""
    found = {entry.name: entry for entry in entry_points(group=GROUP)}
    entry = found.get(settings.driver)
    if entry is None:
        raise CameraError(f"no camera driver is called {settings.driver!r}; installed: {', '.join(sorted(found))}")
    options = {
        "port": settings.port or None,
        "serial": settings.serial or None,
        "capture_target": settings.capture_target,
        "delete_after_download": settings.delete_after_download,
        "timeouts": {"file_s": settings.file_timeout_s},
    }
    camera: Camera = entry.load()(options)
    return camera
