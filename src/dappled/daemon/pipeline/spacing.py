"""Take photographs by the way that the vehicle has flown: one every so many metres, or so that neighbours overlap.

A photograph is due where the vehicle is one spacing, over ground and in a straight line, from the place of the last.
Each is one capture request, in one place. While the body is busy it is waited for, and the photograph is late; a whole
spacing later it has been missed, is refused with the reason, and is not made up for. Without a position of the last
second nothing is due: no photograph is better than one in a place that nobody knows.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

from dappled.clock import Clock
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import IntervalEnd, Shutter
from dappled.decode.geometry import Pose, Quaternion, Vector3, conjugate, metres_per_radian, turned
from dappled.errors import report
from dappled.findings import Code, Finding, Subject, finding
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)
MOST_M = 10_000.0
KIND = "distance"  # of its capture requests
_SERIES = Subject("series")
BY_ITSELF = "settings"  # the source of a series that nobody asked for
_LOOK_S, _WATCH_S, _IDLE_S, _AGAIN_S = 0.02, 0.2, 60.0, 1.0
_LOWER = 0.8
_STALE_MS = 1000.0
_LATE = 1.25  # spacings
LEAST_HEIGHT_M = 2.0  # a barometer's height is no better


@dataclass(frozen=True, slots=True)
class Spacing:
    """What is wanted: metres from one photograph to the next; with 0, the share of a photograph's ground along the way
    that the next one sees too. Raises ValueError for what can't be flown."""

    distance_m: float = 0.0
    overlap: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.distance_m <= MOST_M:
            raise ValueError(f"the distance must be 0 to {MOST_M:g} m")
        if not 0 <= self.overlap <= 0.95:
            raise ValueError("an overlap must be 0 to 0.95")
        if self.distance_m == 0 and self.overlap == 0:
            raise ValueError("neither a distance nor an overlap is given")


@dataclass(frozen=True, slots=True)
class Height:
    """Above the ground, and what says so."""

    metres: float
    source: str

    @classmethod
    def of(cls, pose: Pose) -> Self | None:
        """By what measures it, else above the take-off place; None where both are unknown."""
        if pose.ground is not None:
            return cls(pose.ground.metres, f"by {pose.ground.source}")
        above_m = pose.height_above_home_m
        return None if above_m is None else cls(above_m, "above the take-off place")


class SurveyFacts(Protocol):
    """Where the vehicle is, and what the camera sees of the ground."""

    def pose(self) -> Pose | None:
        """Now."""

    def height(self) -> Height | None:
        """Now; None where it is unknown."""

    def field(self) -> tuple[float, float] | None:
        """The sensor's (height, width) over the focal length; None where one is unknown."""

    def busy(self) -> bool:
        """Whether the body is at work on a shot, so that another would be taken later, and elsewhere."""


@dataclass(slots=True)
class SpacingStatistics:
    """The photographs so far, `late` ones among them, those that were `refused` instead, and how far apart they are to
    be now (None: nobody knows). `trouble` says why none is taken, or that they come late. `began_ns` is monotonic."""

    wanted: Spacing
    spacing_m: float | None = None
    taken: int = 0
    refused: int = 0
    late: int = 0
    height: Height | None = None
    trouble: Finding | None = None
    began_ns: int = 0


@dataclass(slots=True, kw_only=True)
class _Way(SpacingStatistics):
    """A series that runs. `last` is the place of the last photograph (radians, metres above sea level)."""

    source: str
    at_once: bool
    last: tuple[float, float, float] | None = None
    is_late: bool = False  # the last one was
    apart_m: float = 0.0


class DistanceTrigger(OneThread):
    """Serves one series at a time. `mount` leads from camera axes to the body's (see `look`).

    `configured` is the series of the settings. With `from_height_m` above 0 it begins by itself as soon as the vehicle
    is so high above the take-off place, and ends a fifth lower; one that somebody has ended begins again only after
    the vehicle has been below.
    """

    def __init__(
        self,
        shutter: Shutter,
        around: SurveyFacts,
        clock: Clock,
        *,
        mount: Sequence[float],
        configured: Spacing | None = None,
        from_height_m: float = 0.0,
    ) -> None:
        self._shutter, self._around, self._clock, self._mount = shutter, around, clock, mount
        self._configured, self._from_height_m = configured, from_height_m
        self._below = True
        self._lock = threading.Lock()
        self._way: _Way | None = None
        self._wake = threading.Event()
        self._loop = Loop("distance trigger", self._run, clock=clock)

    def stop(self) -> None:
        """End the series and the thread."""
        self.end()
        self._loop.stopping.set()
        self._wake.set()
        self._loop.stop(2.0)

    def begin(self, wanted: Spacing, source: str, *, at_once: bool = False) -> None:
        """Take photographs by distance from now on, in place of a running series; the first one spacing away, or
        `at_once`. The same wish again changes nothing."""
        with self._lock:
            if self._way is not None and (self._way.wanted, self._way.source) == (wanted, source):
                return
            self._way = _Way(wanted, began_ns=self._clock.monotonic_ns(), source=source, at_once=at_once)
        self._wake.set()

    def begin_configured(self, source: str) -> bool:
        """Begin the series of the settings; False where they have none."""
        if self._configured is None:
            return False
        self.begin(self._configured, source)
        return True

    def end(self, *, asked_ns: int | None = None) -> IntervalEnd:
        """End a running series, from any source; one that began after `asked_ns` (monotonic) goes on, as an interval
        (see `Shutter.stop_interval`)."""
        with self._lock:
            if self._way is None:
                return "none ran"
            if asked_ns is not None and self._way.began_ns > asked_ns:
                return "began later"
            self._way = None
        return "stopped"

    def statistics(self) -> SpacingStatistics | None:
        """Of the series that runs; None without one."""
        with self._lock:
            way = self._way
            if way is None:
                return None
            trouble = way.trouble
            if trouble is None and way.is_late:
                spacing_m = way.spacing_m or 0.0
                trouble = finding(Code.SERIES_LATE, _SERIES, apart_m=way.apart_m, spacing_m=spacing_m)
            return replace(way, trouble=trouble)

    def serve(self) -> float:
        """Take the photograph that is due; seconds until the next look. The thread's work."""
        watches = self._configured is not None and self._from_height_m > 0
        pose = self._around.pose() if watches or self._way is not None else None
        if watches:
            self._follow_height(pose)
        with self._lock:
            way = self._way
            if way is None:
                return _WATCH_S if watches else _IDLE_S
            place, way.trouble = _place(pose)
            if place is None:
                return _LOOK_S
            way.spacing_m, way.height, way.trouble = self._spacing(way.wanted, pose)
            apart_m = math.inf if way.last is None else over_ground_m(way.last, place)
            if way.last is None and not way.at_once:
                way.last = place
                return _LOOK_S
            # without a focal length the first photograph tells it
            due = way.last is None or (way.spacing_m is not None and apart_m >= way.spacing_m)
            if not due:
                return _LOOK_S
            missed = way.spacing_m is not None and math.isfinite(apart_m) and apart_m >= 2 * way.spacing_m
            if not missed and self._around.busy():
                return _LOOK_S
            way.taken += 1  # before it is fired: one that can't be is noted, and its number is used
            request = CaptureRequest(way.source, KIND, way.taken + way.refused, acknowledged=False)
            accepted = self._shutter.request(request).accepted
            if not accepted:
                way.taken, way.refused = way.taken - 1, way.refused + 1
            too_far = bool(way.spacing_m and _LATE * way.spacing_m < apart_m < math.inf)
            way.is_late = missed or not accepted or too_far
            if way.is_late:
                way.late += 1
                way.apart_m = apart_m if math.isfinite(apart_m) else 0.0
            way.last = place
            return _LOOK_S

    def _follow_height(self, pose: Pose | None) -> None:
        """Begin the configured series above its height, end it well below."""
        above_m = None if pose is None or _is_stale(pose) else pose.height_above_home_m
        if above_m is None or self._configured is None:
            return
        if above_m < _LOWER * self._from_height_m:
            self._below = True
            with self._lock:
                if self._way is not None and self._way.source == BY_ITSELF:
                    self._way = None
        elif self._below and above_m >= self._from_height_m:
            self._below = False
            if self._way is None:
                self.begin(self._configured, BY_ITSELF, at_once=True)

    def _spacing(self, wanted: Spacing, pose: Pose | None) -> tuple[float | None, Height | None, Finding | None]:
        """(metres, the height that they are by, why they are unknown)."""
        if wanted.distance_m:
            return wanted.distance_m, None, None
        height, field = self._around.height(), self._around.field()
        if height is None or height.metres < LEAST_HEIGHT_M:
            code = Code.SERIES_NO_HEIGHT if height is None else Code.SERIES_TOO_LOW
            return None, height, finding(code, _SERIES)
        if field is None:
            return None, height, finding(Code.SERIES_NO_FIELD, _SERIES)
        velocity, attitude = (None, None) if pose is None else (pose.velocity_ned_m_s, pose.attitude)
        return seen_m(height.metres, field, velocity, attitude, self._mount) * (1 - wanted.overlap), height, None

    def _run(self) -> None:
        while not self._loop.stopping.is_set():
            self._wake.clear()
            try:
                wait_s = self.serve()
            except Exception as error:  # noqa: BLE001  # noting or firing failed: the series goes on
                report(log, "distance trigger", error)
                wait_s = _AGAIN_S
            self._clock.wait(self._wake, wait_s)


def seen_m(
    height_m: float,
    field: tuple[float, float],
    velocity_ned_m_s: Vector3 | None,
    attitude: Quaternion | None,
    mount: Sequence[float],
) -> float:
    """How much of flat ground a level frame sees in the direction of flight, through its middle (m).

    Where that direction is unknown, what it sees along its shorter side.
    """
    tall, wide = field
    shorter = min(tall, wide)
    if velocity_ned_m_s is None or attitude is None:
        return height_m * shorter
    ahead = turned(conjugate(attitude), velocity_ned_m_s)
    right, down = (sum(mount[3 * axis + at] * ahead[axis] for axis in range(3)) for at in (0, 1))
    length = math.hypot(right, down)
    if length < 1e-3:
        return height_m * shorter
    sides = [side * length / abs(part) for side, part in ((wide, right), (tall, down)) if abs(part) > 1e-9]
    return height_m * min(sides)


def _place(pose: Pose | None) -> tuple[tuple[float, float, float] | None, Finding | None]:
    """((latitude, longitude, altitude), None), moved on by what has been flown since; (None, why not)."""
    if pose is None or pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
        return None, finding(Code.SERIES_NO_POSITION, _SERIES)
    if pose.age_ms is None or _is_stale(pose):
        return None, finding(Code.SERIES_OLD_POSITION, _SERIES)
    north_m, east_m = metres_per_radian(pose.latitude_rad, pose.altitude_msl_m)
    north, east, _ = pose.velocity_ned_m_s or (0.0, 0.0, 0.0)
    age_s = pose.age_ms / 1e3
    at = pose.latitude_rad + north * age_s / north_m, pose.longitude_rad + east * age_s / east_m
    return (*at, pose.altitude_msl_m), None


def _is_stale(pose: Pose) -> bool:
    return pose.age_ms is None or pose.age_ms > _STALE_MS


def over_ground_m(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    """Over ground."""
    north_m, east_m = metres_per_radian(a[0], a[2])
    return math.hypot((b[0] - a[0]) * north_m, math.remainder(b[1] - a[1], 2 * math.pi) * east_m)
