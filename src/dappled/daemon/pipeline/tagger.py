"""When a frame was exposed, and what is known of it: the tag."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from dappled.config.settings import CameraSettings
from dappled.decode.geometry.pose import Pose
from dappled.drivers.raw.raw_file import ExposureSettings
from dappled.flight import Frame, Shot, Tag

LATENCY_SOURCE = "trigger call + body latency"
WISH_SOURCE = "wish + body latency"
_UNSEEN_NS = 10**9  # how late a trigger call may be, where not even the file's arrival bounds it


@dataclass(frozen=True, slots=True)
class BodyLatency:
    """From the trigger call to the start of the exposure: mean and 1 σ, and where the figure comes from."""

    mean_ms: float
    sigma_ms: float
    source: str

    @classmethod
    def of(cls, settings: CameraSettings) -> Self:
        """As it is configured."""
        return cls(settings.latency_ms, settings.latency_sigma_ms, LATENCY_SOURCE)


@dataclass(frozen=True, slots=True)
class ExposureTime:
    """Mid-exposure in UTC with its 1 σ, and how that was had.

    `half_ns` is half the exposure as far as known. `called_utc_ns` is when the trigger call was made: nothing exposes
    before it; None where nobody knows.
    """

    utc_ns: int
    sigma_ns: int
    source: str
    half_ns: int = 0
    called_utc_ns: int | None = None


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


def called_utc_ns(shot: Shot, called_monotonic_ns: int) -> int:
    """When the trigger call was made, on the clock of the wish: to the nanosecond the same in a replay."""
    return called_monotonic_ns + shot.wished_utc_ns - shot.wished_monotonic_ns


def mid_exposure(fired_utc_ns: int, latency: BodyLatency, exposure_s: float | None) -> ExposureTime:
    """The trigger call's time plus the body's latency plus half the exposure (none, where it is not known)."""
    half_ns = round((exposure_s or 0.0) / 2 * 1e9)
    return ExposureTime(
        fired_utc_ns + round(latency.mean_ms * 1e6) + half_ns,
        round(latency.sigma_ms * 1e6),
        latency.source,
        half_ns,
        fired_utc_ns,
    )


def by_wish(
    wished_utc_ns: int, arrived_utc_ns: int | None, latency: BodyLatency, exposure_s: float | None
) -> ExposureTime:
    """The wish's time plus the body's latency, where nobody saw the trigger call.

    The call may have come at any time up to the file's arrival: that goes into sigma, as an even chance from 0 on.
    """
    exposure = mid_exposure(wished_utc_ns, latency, exposure_s)
    late_ns = _UNSEEN_NS if arrived_utc_ns is None else max(0, arrived_utc_ns - exposure.utc_ns - exposure.half_ns)
    sigma_ns = round(math.hypot(exposure.sigma_ns, late_ns / math.sqrt(3)))
    return replace(exposure, sigma_ns=sigma_ns, source=WISH_SOURCE)


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
