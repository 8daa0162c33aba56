"""`camera.driver = "simulated"`: the simulated masked camera as an ordinary driver, with nothing between it and the
daemon. (`dappled run --simulate` puts the same camera behind libgphoto2 and PTP/IP.)

`[camera.options]`: seed, scale, scene and law as `reference_camera` has them, f_number, and folder, for what the
simulation knows of each shot.
"""

from __future__ import annotations

import secrets
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dappled.drivers.camera import CameraError, Identity
from dappled.drivers.composed import ComposedCamera, Plan
from dappled.drivers.options import only, seconds_of
from dappled.drivers.pickup import FolderSource
from dappled.mocks.body import BodyOptions
from dappled.mocks.pictures import exposer

_KNOWN = ("timeouts", "seed", "scale", "scene", "law", "f_number", "folder", "picture")
_HOLD_S = 0.02


def open_camera(settings: Mapping[str, Any]) -> ComposedCamera:
    """The driver for these settings; `start` it. Raises CameraError for a wrong one."""
    only(settings, _KNOWN)
    folder = settings.get("folder")
    given = {name: settings[name] for name in _KNOWN if name in settings and name not in ("timeouts", "folder")}
    try:
        options = BodyOptions(**given, truth=None if folder is None else Path(folder))
    except TypeError as error:
        raise CameraError(f"camera.options of the simulated camera are not right: {error}") from None
    card = Path(tempfile.gettempdir()) / f"dappled-card-{secrets.token_hex(8)}"
    plan = Plan(file_s=seconds_of(settings, "file_s", 30.0), hold_s=_HOLD_S, poll_s=0.02)
    identity = Identity("dappled", "Simulated Masked Camera", f"SIM{options.seed:08d}", "simulated")
    return ComposedCamera(identity, Exposing(options, card), FolderSource(card), plan)


class Exposing:
    """A shutter line whose press takes a picture: the file appears on the card, whole, some time later.

    Pictures are taken one by one, in the order in which they were asked for.
    """

    def __init__(self, options: BodyOptions, card: Path) -> None:
        self._options, self._card = options, card
        self._expose: Callable[[int, int], tuple[bytes, str]] | None = None
        self._taken = 0
        self._at_work: threading.Thread | None = None

    def open(self) -> None:
        """See ShutterLine."""
        try:
            self._expose = self._expose or exposer(self._options)
            self._card.mkdir(mode=0o700, exist_ok=True)
        except (ValueError, OSError) as error:
            raise CameraError(f"the simulated camera can't be: {error}") from None

    def press(self) -> None:
        """See ShutterLine."""
        self._taken += 1
        work = (time.monotonic_ns(), self._taken, self._at_work)
        self._at_work = threading.Thread(target=self._take, args=work, name="exposure", daemon=True)
        self._at_work.start()

    def _take(self, pressed_ns: int, number: int, before: threading.Thread | None) -> None:
        if before is not None:
            before.join()
        assert self._expose is not None
        data, extension = self._expose(pressed_ns, number)
        target = self._card / f"SIM_{number:04d}.{extension.upper()}"
        part = target.with_name(f".{target.name}")
        try:
            part.write_bytes(data)
            part.rename(target)
        except OSError:
            return  # the camera was closed meanwhile, its card with it

    def let_go(self) -> None:
        """See ShutterLine."""

    def close(self) -> None:
        """See ShutterLine: files that are open stay readable."""
        shutil.rmtree(self._card, ignore_errors=True)
