"""Raw file and JPEG of one exposure are one frame: the raw file is the frame, the JPEG its companion, whichever comes
first. On a card they are told by their names (IMG_0042.CR2, IMG_0042.JPG); libgphoto2 makes names up for files in the
camera's memory (capt0000.cr2, capt0001.jpg): there they are told by their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dappled.drivers.camera import Arrival, Setting
from dappled.drivers.gphoto2.protocol import (
    CameraFile,
)

_Stem = tuple[str, str]
Waiting = tuple[CameraFile, Arrival, int | None]


def makes_pairs(settings: Sequence[Setting]) -> bool:
    """Whether the camera is set to raw and JPEG: "RAW + Large Fine JPEG", "NEF+Fine"."""
    return any(each.name == "image_format" and "+" in each.value for each in settings)


def is_jpeg(name: str) -> bool:
    """By the name's extension."""
    return name.lower().endswith((".jpg", ".jpeg"))


@dataclass(slots=True)
class Pairs:
    """What came alone so far, and the frame that was delivered last."""

    _held: dict[_Stem, Waiting] = field(default_factory=dict)
    _last: tuple[_Stem, bool, int] | None = None

    def holds_back(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> bool:
        """Whether a file waits here for the raw file beside it. For a camera that makes pairs."""
        if not is_jpeg(arrival.name) or self.main_of(file) is not None:
            return False
        self._held[_stem(file)] = (file, arrival, taken_s)
        return True

    def main_of(self, file: CameraFile) -> int | None:
        """The shot that this file is the companion of; None for a frame of its own."""
        if self._last is None:
            return None
        stem, jpeg, shot = self._last
        return shot if stem == _stem(file) and jpeg != is_jpeg(file.name) else None

    def delivered(self, file: CameraFile, shot: int | None) -> list[Waiting]:
        """A frame was delivered; the companion that waited for it, if one did."""
        self._last = None if shot is None else (_stem(file), is_jpeg(file.name), shot)
        waiting = self._held.pop(_stem(file), None)
        return [] if waiting is None else [waiting]

    def overdue(self, before_ns: int) -> list[Waiting]:
        """What came before this time and still waits: it goes on as a frame of its own."""
        late = [stem for stem, (_, arrival, _) in self._held.items() if arrival.monotonic_ns < before_ns]
        return [self._held.pop(stem) for stem in late]


def _stem(file: CameraFile) -> _Stem:
    return file.folder, "" if file.in_memory else file.name.rpartition(".")[0]
