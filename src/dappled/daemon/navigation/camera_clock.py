"""The camera's own clock, which EXIF tells in whole seconds and without a zone: its offset is learnt from shots.

A shot with a better time gives one offset, early by a part of the clock's step that is spread evenly over it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from dappled.daemon.pipeline.tagger import ExposureTime

_KEPT = 256
_LEAST = 3
SOURCE = "camera clock (EXIF)"


@dataclass(frozen=True, slots=True)
class CameraClock:
    """The camera's time minus UTC, from `shots`: (camera time − UTC, its 1 σ, its step), nanoseconds."""

    shots: tuple[tuple[int, int, int], ...] = ()

    def learnt(self, shown_ns: int, step_ns: int, exposure: ExposureTime) -> CameraClock:
        """With one more shot, whose begin is known otherwise. The last 256 count; only this one where it contradicts
        them: then the camera's clock was set in between."""
        offset_ns = shown_ns - (exposure.utc_ns - exposure.half_ns)
        shots = (*self.shots, (offset_ns, exposure.sigma_ns, step_ns))[-_KEPT:]
        return CameraClock(shots if _agree(shots) else shots[-1:])

    def offset_ns(self) -> tuple[int, int] | None:
        """The camera's time minus UTC with 1 σ; None from fewer than three shots."""
        if len(self.shots) < _LEAST:
            return None
        centre, (sigma, step) = self.shots[-1][0], _spread(self.shots)
        shifts = [offset - centre for offset, _, _ in self.shots]
        # A cut-off time is uniform over one step: its mean is half a step early, with step / √12 a shot.
        mean = sum(shifts) / len(shifts) + step / 2
        by_mean = math.hypot(sigma, step / math.sqrt(12)) / math.sqrt(len(shifts))
        return centre + round(mean), round(by_mean)


def _spread(shots: tuple[tuple[int, int, int], ...]) -> tuple[float, int]:
    """(1 σ of their times, the clock's step)."""
    return math.sqrt(sum(s * s for _, s, _ in shots) / len(shots)), max(step for _, _, step in shots)


def _agree(shots: tuple[tuple[int, int, int], ...]) -> bool:
    sigma, step = _spread(shots)
    offsets = [offset for offset, _, _ in shots]
    return max(offsets) - min(offsets) <= step + 8 * sigma


def exposure_from_camera(
    clock: CameraClock, shown_ns: int, step_ns: int, exposure_s: float | None
) -> ExposureTime | None:
    """Mid-exposure by the camera's clock, the middle of the second (or `step_ns`) that it shows; None while its offset
    is not known."""
    offset = clock.offset_ns()
    if offset is None:
        return None
    half_ns = round((exposure_s or 0.0) / 2 * 1e9)
    sigma_ns = round(math.hypot(offset[1], step_ns / math.sqrt(12)))
    return ExposureTime(shown_ns - offset[0] + step_ns // 2 + half_ns, sigma_ns, SOURCE, half_ns)


def shown(taken: str | None) -> tuple[int, int] | None:
    """(time, step) in nanoseconds of what EXIF says, ISO 8601 without a zone, taken as if it were UTC."""
    if taken is None:
        return None
    whole, _, fraction = taken.partition(".")
    if fraction and not (fraction.isascii() and fraction.isdigit()):
        return None
    try:
        seconds = round(datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp())
    except ValueError:
        return None
    digits = fraction[:9]
    return seconds * 10**9 + int(digits.ljust(9, "0") or 0), 10 ** (9 - len(digits))
