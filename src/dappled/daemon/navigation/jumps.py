"""Find positions that contradict the velocities sent with them: jumps.

A receiver that has lost its way, or an estimator that was reset, moves the position by metres while the velocity says
nothing of it. Which side of a jump is right can't be known: a position near one is in doubt by its size, and all those
after it are until there is evidence that it is over. It is over when the position has jumped back, or is where a
receiver is that has not jumped itself: since before the jump, or for a minute since it came back from a gap.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from dappled.daemon.navigation.samples import NEAREST_NS, GnssSample, Jump, PositionSample
from dappled.decode.geometry import Vector3, displacement, norm

_WINDOW_NS = 10**9  # a jump that is spread over several samples is whole within
_FLOOR_M = 2.0  # a position and a velocity that drift apart as filters do
_STALE_S = 0.25  # by which a position may be older than its time says: a receiver's interval, in messages sent faster
_BETWEEN_M_S2 = 2.5  # × time²: there and back at 10 m/s² between two samples with the same velocity
_BACK = 0.1  # of the largest doubt: so near to where it was is back
_APART_M, _APART_S = 5.0, 0.6  # by which estimator and receiver may differ; the age of a receiver's message
_ANEW_NS = 60 * 10**9  # how long a receiver that was not heard before a jump has to agree with all velocities
_UNKNOWN_M_S = 60.0  # of a vehicle whose messages have no velocity (exactly 0, 0, 0)
_NONE: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Sum:
    """Unexplained metres up to a sample, and how many a healthy autopilot may have."""

    boot_ns: int
    metres: Vector3
    allowed_m: float


class JumpFinder:
    """Compares each position with the velocities since those of the last second."""

    def __init__(self, standing_m: Vector3 = _NONE) -> None:
        """`standing_m` is in doubt from the beginning: by jumps that an earlier flight has seen."""
        self._last: PositionSample | None = None
        self._sums: deque[_Sum] = deque()
        self._widest_m, self.standing_m = norm(standing_m), standing_m
        self.since = self.since_ns = 0  # packet and arrival of the first of the positions without a gap
        self.begun = 0  # packet of the doubt's first jump

    def jump(self, sample: PositionSample, first: int) -> Jump | None:
        """Take the next position; `first` is the first packet of the autopilot's boot. The jump that ends there, if
        any."""
        last, self._last = self._last, sample
        if last is None or last.number < first or sample.boot_ns - last.boot_ns > NEAREST_NS:
            self._sums = deque([_Sum(sample.boot_ns, (0.0, 0.0, 0.0), 0.0)])
            self.since, self.since_ns = sample.number, sample.stamp_ns
            return None
        moved, allowed_m = _unexplained(last, sample)
        before = self._sums[-1]
        metres = tuple(a + b for a, b in zip(before.metres, moved, strict=True))
        found = _Sum(sample.boot_ns, (metres[0], metres[1], metres[2]), before.allowed_m + allowed_m)
        while len(self._sums) > 1 and self._sums[0].boot_ns < sample.boot_ns - _WINDOW_NS:
            self._sums.popleft()
        across_m_s, upright_m_s = _steady_m_s(last, sample)
        most, by_m = 0.0, (0.0, 0.0, 0.0)
        for one in self._sums:
            then = one.metres
            north, east, down = metres[0] - then[0], metres[1] - then[1], metres[2] - then[2]
            floor_m = _FLOOR_M + found.allowed_m - one.allowed_m
            across_m = math.hypot(north, east) - floor_m - _STALE_S * across_m_s
            upright_m = abs(down) - floor_m - _STALE_S * upright_m_s
            if max(across_m, upright_m) > most:
                most = max(across_m, upright_m)
                by_m = (*((north, east) if across_m > 0 else (0.0, 0.0)), down if upright_m > 0 else 0.0)
        if most > 0:
            self._sums.clear()
        self._sums.append(found)
        if most <= 0:
            return None
        self.begun = sample.number if self.standing_m == _NONE else self.begun
        north, east, down = (a + b for a, b in zip(self.standing_m, by_m, strict=True))
        self._widest_m = max(self._widest_m, norm((north, east, down)))
        back = norm((north, east, down)) <= _FLOOR_M + _BACK * self._widest_m < self._widest_m
        if back:
            self._widest_m = 0.0
        self.standing_m = _NONE if back else (north, east, down)
        return Jump(sample.number, sample.stamp_ns, sample.boot_ns, by_m, self.standing_m)

    def over(self, sample: PositionSample, number: int, stamp_ns: int) -> Jump:
        """That the doubt is over from this packet on, by other evidence; `sample` is the last position."""
        self._widest_m, self.standing_m = 0.0, _NONE
        return Jump(number, stamp_ns, sample.boot_ns, _NONE, _NONE)


class ReceiverTrack:
    """Whether the receiver has jumped, by the estimator's velocities, and whether the estimator is where it is."""

    def __init__(self) -> None:
        self._finder, self._compared = JumpFinder(), -1

    def confirms(self, heard: GnssSample, estimate: PositionSample, first: int, begun: int, doubt_m: Vector3) -> bool:
        """Take the receiver's place with a fix, once for each position. Whether it has not jumped since before packet
        `begun`, or for a minute, and the last position is there as well: in the plane, in height, or both, as far as it
        is in doubt. A barometer's height may be metres from a receiver's."""
        if estimate.number == self._compared:
            return False
        self._compared = estimate.number
        latitude_rad, longitude_rad, altitude_m = heard.place
        there = replace(
            estimate,
            number=heard.number,
            stamp_ns=heard.stamp_ns,
            latitude_rad=latitude_rad,
            longitude_rad=longitude_rad,
            altitude_msl_m=altitude_m,
        )
        self._finder.jump(there, first)
        (*across_m, upright_m), (*own_m, own_upright_m) = displacement(there, estimate), self._finder.standing_m
        near_m = _APART_M + _APART_S * norm(estimate.velocity_ned_m_s)
        if any(doubt_m[:2]) and (any(own_m) or math.hypot(*across_m) > near_m):
            return False
        if doubt_m[2] and (own_upright_m or abs(upright_m) > near_m):
            return False
        return self._finder.since < begun or heard.stamp_ns - self._finder.since_ns >= _ANEW_NS


def _unexplained(a: PositionSample, b: PositionSample) -> tuple[Vector3, float]:
    """What the position moved beyond the mean velocity, and how much of that is nothing (metres).

    By the time between their own times or by that between their arrivals, whichever explains more: a clock that steps
    is no jump. A vertical speed may count upwards, as old ArduCopters send it.
    """
    north, east, down = displacement(a, b)
    vn, ve, vd = (0.5 * (x + y) for x, y in zip(a.velocity_ned_m_s, b.velocity_ned_m_s, strict=True))
    own_s, arrived_s = (b.boot_ns - a.boot_ns) / 1e9, (b.stamp_ns - a.stamp_ns) / 1e9
    across = min(((north - vn * s, east - ve * s) for s in (own_s, arrived_s)), key=lambda by: math.hypot(*by))
    upright = min((down - way * vd * s for s in (own_s, arrived_s) for way in (1, -1)), key=abs)
    unknown = not any(a.velocity_ned_m_s) and not any(b.velocity_ned_m_s)
    return (*across, upright), _BETWEEN_M_S2 * own_s**2 + (_UNKNOWN_M_S * own_s if unknown else 0.0)


def _steady_m_s(a: PositionSample, b: PositionSample) -> tuple[float, float]:
    """The speed that both samples have, horizontally and vertically."""
    (an, ae, ad), (bn, be, bd) = a.velocity_ned_m_s, b.velocity_ned_m_s
    return min(math.hypot(an, ae), math.hypot(bn, be)), min(abs(ad), abs(bd))
