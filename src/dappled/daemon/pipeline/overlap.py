"""How far a flight's last two photographs are apart, and how much ground both see: too fast is told in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dappled.daemon.pipeline.spacing import LEAST_HEIGHT_M, Height, SurveyFacts, over_ground_m, seen_m
from dappled.decode.geometry import Pose
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import Tag

_SERIES_NS = 15 * 10**9  # photographs farther apart in time are none of one series
_TOO_FAR = 1.25  # of the wanted way from one to the next


@dataclass(frozen=True, slots=True)
class FrameOverlap:
    """Of a frame with the one before it: how far apart over ground, the share of what a frame sees along the way that
    both see (below 0: a gap between them), and the speed over ground."""

    frame: int
    apart_m: float
    share: float
    speed_m_s: float


class OverlapWatch:
    """Follows the tags of a flight. `wanted` is the settings' overlap, or 0; `mount` leads from camera
    axes to the body's."""

    def __init__(self, around: SurveyFacts, mount: Sequence[float], wanted: float) -> None:
        self._around, self._mount, self._wanted = around, mount, wanted
        self._before: Tag | None = None
        self._last: FrameOverlap | None = None

    def take(self, tag: Tag) -> None:
        """The next frame; one that comes late is left out."""
        before = self._before
        if before is not None and tag.index < before.index:
            return
        self._before, self._last = tag, None if before is None else self._between(before, tag)

    def last(self, utc_ns: int) -> FrameOverlap | None:
        """Of the last two frames; None where one has no place or height, or the series is over."""
        is_over = self._before is None or utc_ns - self._before.utc_ns > _SERIES_NS
        return None if is_over else self._last

    def trouble(self, utc_ns: int) -> Finding | None:
        """That the vehicle is too fast for the overlap of the settings."""
        last = self.last(utc_ns)
        if last is None or not self._wanted or 1 - last.share <= _TOO_FAR * (1 - self._wanted):
            return None
        return finding(
            Code.SERIES_TOO_FAST,
            Subject("series"),
            apart_m=last.apart_m,
            speed_m_s=last.speed_m_s,
            overlap=max(0.0, last.share),
            wanted=self._wanted,
            at_most_m_s=last.speed_m_s * (1 - self._wanted) / (1 - last.share),
        )

    def _between(self, before: Tag, now: Tag) -> FrameOverlap | None:
        passed_ns, places = now.utc_ns - before.utc_ns, [_place(one.pose) for one in (before, now)]
        height_m, field = _height_m(now.pose), self._around.field()
        if (
            not 0 < passed_ns <= _SERIES_NS
            or places[0] is None
            or places[1] is None
            or height_m is None
            or field is None
        ):
            return None
        way_m = over_ground_m(places[0], places[1])
        seen = seen_m(height_m, field, now.pose.velocity_ned_m_s, now.pose.attitude, self._mount)
        return FrameOverlap(now.index, way_m, 1 - way_m / seen, way_m / (passed_ns / 1e9))


def _place(pose: Pose) -> tuple[float, float, float] | None:
    if pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
        return None
    return pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m


def _height_m(pose: Pose) -> float | None:
    """None where unknown, or too low."""
    height = Height.of(pose)
    return None if height is None or not LEAST_HEIGHT_M <= height.metres < math.inf else height.metres
