"""The driver `camera.driver = "simulated"`: the simulated masked camera in the daemon's own process.

`dappled run --simulate` puts the same camera behind libgphoto2 and PTP/IP.

`[camera.options]`: seed, scale, scene and law as in `reference_camera`; f_number; and folder, for the truth about each
shot.
"""

from __future__ import annotations

import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from dappled.config.schema import ConfigError, TomlSource, build, setting
from dappled.drivers.camera import CameraError, Identity, check_options, seconds_option
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.sources import FolderSource
from dappled.mocks.body.body import BodyOptions, pictures
from dappled.workers import Worker

_HOLD_S = 0.02
_WAITING = 64


@dataclass(frozen=True, slots=True)
class _Options:
    """`[camera.options]`, as `BodyOptions` has them; `folder` is its `truth`."""

    seed: int = setting(1, "seed of everything drawn at random", low=0, high=2**32)
    scale: float = setting(1.0, "share of the sensor's side", low=0.01, high=4)
    scene: str = setting("terrain", "terrain, bench, white, or a folder of views")
    law: str = setting("geometric", "law of the carriers", choices=("geometric", "fd"))
    f_number: float | None = setting(None, "the lens' aperture", low=0.1, high=1000)
    folder: str | None = setting(None, "folder for what the simulation knows of each shot")
    picture: str = setting("simulated", "simulated, pattern:SIZE:EXTENSION, or a file")


_KNOWN = ("timeouts", *(one.name for one in fields(_Options)))


def open_camera(settings: Mapping[str, Any]) -> ComposedCamera:
    """The driver for these settings; `start` it. Raises CameraError for a wrong one."""
    check_options(settings, _KNOWN)
    given = {name: value for name, value in settings.items() if name != "timeouts"}
    try:
        wanted = asdict(build(_Options, given, TomlSource("camera.options"), ""))
    except ConfigError as error:
        raise CameraError(str(error)) from None
    truth = wanted.pop("folder") or ""
    options = BodyOptions(**wanted, truth=truth)
    card = Path(tempfile.gettempdir()) / f"dappled-card-{secrets.token_hex(8)}"
    plan = ComposedSettings(file_s=seconds_option(settings, "file_s", 30.0), hold_s=_HOLD_S, poll_s=0.02)
    identity = Identity("dappled", "Simulated Masked Camera", f"SIM{options.seed:08d}", "simulated")
    return ComposedCamera(identity, Exposing(options, card), FolderSource(card), plan)


class Exposing:
    """A shutter line that takes a picture when it is pressed. The complete file appears on the card some time later.

    Pictures are taken one by one, in the order of the presses.
    """

    def __init__(self, options: BodyOptions, card: Path) -> None:
        self._options, self._card = options, card
        self._expose: Callable[[int, int], tuple[bytes, str]] | None = None
        self._taken = 0
        self._exposures: Worker[tuple[int, int]] | None = None

    def open(self) -> None:
        """Acquire the line; called again after an error."""
        try:
            self._expose = self._expose or pictures(self._options).expose
            self._card.mkdir(mode=0o700, exist_ok=True)
        except (ValueError, OSError) as error:
            raise CameraError(f"the simulated camera can't start: {error}") from None
        if self._exposures is None:
            self._exposures = Worker("exposure", self._take, capacity=_WAITING)
            self._exposures.start()

    def press(self) -> None:
        """Press the shutter, now."""
        assert self._exposures is not None
        self._taken += 1
        self._exposures.put((time.monotonic_ns(), self._taken))

    def _take(self, exposure: tuple[int, int]) -> None:
        pressed_ns, number = exposure
        assert self._expose is not None
        data, extension = self._expose(pressed_ns, number)
        target = self._card / f"SIM_{number:04d}.{extension.upper()}"
        part = target.with_name(f".{target.name}")
        try:
            part.write_bytes(data)
            part.rename(target)
        except OSError:
            return  # the camera was closed meanwhile, and its card deleted

    def let_go(self) -> None:
        """Release the shutter after it was held long enough."""

    def close(self) -> None:
        """Give the line back, released. Files that are open stay readable."""
        exposures, self._exposures = self._exposures, None
        if exposures is not None:
            exposures.stop(0.0)
        shutil.rmtree(self._card, ignore_errors=True)
