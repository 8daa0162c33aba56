"""Put together what is known of a frame: the tag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from dappled.daemon.navigation import ExposureTime
from dappled.decode.geometry import Pose
from dappled.drivers.raw.raw_file import ExposureSettings
from dappled.flight import Frame, Tag


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """What the file says of the exposure; None where it doesn't. `taken` is the camera's own time (see EXIF)."""

    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    model: str = ""
    taken: str | None = None

    @classmethod
    def of(cls, facts: ExposureSettings) -> Self:
        """From a file's metadata."""
        return cls(facts.focal_length_mm, facts.f_number, facts.exposure_s, facts.iso, facts.model or "", facts.taken)


class Zoom:
    """The focal length from frame to frame: one that is changed in mid-flight moves every carrier."""

    def __init__(self) -> None:
        self._last: tuple[int, float] | None = None

    def look(self, index: int, focal_length_mm: float | None) -> str | None:
        """A sentence where a frame's focal length is another than that of the last frame that told one."""
        if focal_length_mm is None:
            return None
        before, self._last = self._last, (index, focal_length_mm)
        if before is None or before[1] == focal_length_mm:
            return None
        return f"the focal length is {focal_length_mm:g} mm; it was {before[1]:g} mm at frame {before[0]}"


def tag(frame: Frame, exposure: ExposureTime, settings: FrameSettings, *, camera: str, mask: str, pose: Pose) -> Tag:
    """All that is known of a frame, in one record."""
    return Tag(
        index=frame.index,
        utc_ns=exposure.utc_ns,
        utc_sigma_ns=exposure.sigma_ns,
        time_source=exposure.source,
        focal_length_mm=settings.focal_length_mm,
        f_number=settings.f_number,
        exposure_s=settings.exposure_s,
        iso=settings.iso,
        camera=camera,
        mask=mask,
        frame_sha256=frame.sha256,
        pose=pose,
    )
