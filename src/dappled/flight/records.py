"""The values that a flight is made of. All are facts, written once; what is not known is None.

One number, the image index, names a shot, the frame that it became, its file, and its CAMERA_IMAGE_CAPTURED. It goes
on over restarts. A shot that failed keeps its index.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from dappled.decode.geometry.pose import Pose

ShotState = Literal["wished", "fired", "safe", "failed"]


@dataclass(frozen=True, slots=True)
class Cause:
    """Who wanted the shot. `source` is "mavlink:255/190", "console", "replay" …; `kind` the message or act."""

    source: str
    kind: str
    sequence: int | None = None


@dataclass(frozen=True, slots=True)
class Shot:
    """One wish to expose, with its cause. Times are the daemon's own clocks at the wish."""

    index: int
    cause: Cause
    wished_utc_ns: int
    wished_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class Frame:
    """What the camera delivered for a shot, safe on disk: `name` is relative to the flight folder."""

    index: int
    name: str
    camera_name: str
    size: int
    sha256: str
    arrived_utc_ns: int


@dataclass(frozen=True, slots=True)
class Tag:
    """What is known of a frame apart from its pixels. Times are mid-exposure, UTC; sigma one standard deviation."""

    index: int
    utc_ns: int
    utc_sigma_ns: int
    time_source: str
    focal_length_mm: float | None
    f_number: float | None
    exposure_s: float | None
    iso: float | None
    camera: str
    mask: str
    frame_sha256: str
    pose: Pose


def canonical(value: Any) -> bytes:
    """One byte string for equal values: JSON with sorted keys, no spaces, shortest round-trip floats, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(record: Pose | Tag | Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a record's canonical form."""
    value = record if isinstance(record, Mapping) else asdict(record)
    return hashlib.sha256(canonical(value)).hexdigest()
