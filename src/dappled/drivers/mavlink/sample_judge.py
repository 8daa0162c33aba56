"""Judge an autopilot's samples: one rule for a live link and for every kind of log.

A sample out of range is none. One that leaves those before it faster than any vehicle moves begins a track of its own;
it counts once that track has three samples over a second. So bad values, one or several in a row, come to nothing, and
an estimator that was reset counts again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HIGHEST_M = 100_000.0  # above or below the sea's level
FASTEST_M_S = 300.0
_EARTH_M = 6_371_000.0
_CERTAIN, _CERTAIN_S = 3, 1.0
_MOST_TRACKS = 8


@dataclass(frozen=True, slots=True)
class Motion:
    """By how much a quantity may differ between two samples: `floor`, and `per_s` for each second between them."""

    per_s: float
    floor: float


OF_PLACES = Motion(FASTEST_M_S, 50.0)  # metres
OF_VELOCITIES = Motion(100.0, 5.0)  # m/s
OF_ATTITUDES = Motion(7.0, 0.5)  # of rotation matrices: 1.4 for each radian, so 5 rad/s and 20 degrees


def point_m(lat_rad: Any, lon_rad: Any, alt_m: Any) -> tuple[Any, Any, Any]:
    """A place as a point around the earth's centre, for distances across poles and 180 degrees."""
    across = (_EARTH_M + alt_m) * np.cos(lat_rad)
    return across * np.cos(lon_rad), across * np.sin(lon_rad), (_EARTH_M + alt_m) * np.sin(lat_rad)


@dataclass(slots=True, eq=False)
class Track:
    """Samples that follow from each other."""

    since_s: float
    last_s: float
    values: Sequence[Sequence[float]]
    count: int = 1

    @property
    def certain(self) -> bool:
        """Whether it was told often and long enough to count."""
        return self.count >= _CERTAIN and self.last_s - self.since_s >= _CERTAIN_S


class Tracks:
    """The tracks of one kind of sample, whose quantities move as `motions` say."""

    def __init__(self, *motions: Motion) -> None:
        self._motions, self._tracks = motions, list[Track]()

    def of(self, at_s: float, values: Sequence[Sequence[float]]) -> Track:
        """Take the next sample. Its track: the last extended one that it follows from, or a new one."""
        for place in range(len(self._tracks) - 1, -1, -1):
            track = self._tracks[place]
            if self._follows(track, at_s, values):
                track.count += at_s > track.last_s
                track.last_s, track.values = max(at_s, track.last_s), values
                self._tracks.append(self._tracks.pop(place))
                return track
        track = Track(at_s, at_s, values)
        self._tracks = [*self._tracks[1 - _MOST_TRACKS :], track]
        return track

    def _follows(self, track: Track, at_s: float, values: Sequence[Sequence[float]]) -> bool:
        span_s = abs(at_s - track.last_s)
        return all(
            math.dist(new, old) <= motion.floor + motion.per_s * span_s
            for new, old, motion in zip(values, track.values, self._motions, strict=True)
        )


def steady(times_us: NDArray[np.int64], values: NDArray[np.float64], motion: Motion) -> NDArray[np.bool_]:
    """Which of a whole log's values (k, n), in the order of time, count (n,); where no track is certain those of the
    longest one do."""
    steps, span_s = np.linalg.norm(np.diff(values, axis=1), axis=0), np.diff(times_us) / 1e6
    if (steps <= motion.floor + motion.per_s * span_s).all():
        return np.ones(len(times_us), dtype=bool)
    tracks = Tracks(motion)
    found = [
        tracks.of(at_us / 1e6, (value,)) for at_us, value in zip(times_us.tolist(), values.T.tolist(), strict=True)
    ]
    longest = max(found, key=lambda track: track.count)
    certain = any(track.certain for track in found)
    return np.array([track.certain if certain else track is longest for track in found])
