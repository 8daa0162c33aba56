"""Look through the camera before a flight: when the console may, and what it is told otherwise.

Not while the camera shoots, nor within ten seconds of a shot: libgphoto2 reads a picture in one piece, and a shot that
is asked for meanwhile waits for it.
"""

from __future__ import annotations

from typing import Any

from dappled.clock import Clock
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.camera import Camera, CameraError, LiveView

QUIET_S = 10.0


class CameraLook:
    """Answers a page that looks through the camera. One thread asks."""

    def __init__(self, camera: Camera, shutter: Shutter, clock: Clock) -> None:
        self._camera, self._shutter, self._clock = camera, shutter, clock
        self._shots = 0
        self._shot_ns: int | None = None  # when a shot was last seen under way, or new

    def answer(self) -> dict[str, Any]:
        """{"ok": True} with the JPEG as "picture" once there is one, or {"ok": False} with the reason as "error"."""
        if not isinstance(self._camera, LiveView):
            return {"ok": False, "error": "this camera has no live view"}
        if self._shoots():
            return {"ok": False, "error": f"live view is off while shooting, and for {QUIET_S:g} s after a shot"}
        try:
            picture = self._camera.look()
        except CameraError as error:
            return {"ok": False, "error": str(error)}
        if picture is None:
            return {"ok": True, "text": "waiting for the camera's picture"}
        return {"ok": True, "picture": picture.jpeg}

    def _shoots(self) -> bool:
        now, now_ns = self._shutter.statistics(), self._clock.monotonic_ns()
        if now.interval_s is not None or now.pending or now.shots != self._shots:
            self._shots, self._shot_ns = now.shots, now_ns
        return self._shot_ns is not None and now_ns - self._shot_ns < QUIET_S * 1e9
