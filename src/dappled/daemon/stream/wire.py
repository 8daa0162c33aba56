"""What goes over ZeroMQ: multipart [topic, header, body?], the header one JSON object, the body arrays end to end."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.errors import DappledError
from dappled.flight.records import Tag

VERSION = 1
TOPICS = ("start", "frame", "slices", "depth", "preview", "health", "end")


class WireError(DappledError):
    """An endpoint, a message or a request is not usable; one sentence."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it is sent or was received. `body` is bytes-like or None."""

    topic: str
    header: Mapping[str, Any]
    body: Any = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The body's arrays by name, as views into the body. Raises WireError when header and body disagree."""
        found: dict[str, NDArray[Any]] = {}
        start = 0
        data = memoryview(self.body or b"").cast("B")
        try:
            for entry in self.header.get("arrays", []):
                dtype, shape = np.dtype(entry["dtype"]), _shape(entry["shape"])
                size = dtype.itemsize * math.prod(shape)
                if start + size > len(data):
                    raise WireError(f"the body of {self.topic} ends inside array {entry['name']!r}")
                found[entry["name"]] = np.frombuffer(data[start : start + size], dtype).reshape(shape)
                start += size
        except (KeyError, TypeError, ValueError) as error:
            raise WireError(f"the arrays of {self.topic} are not described as they are: {error}") from None
        return found


def _shape(sides: Sequence[int]) -> tuple[int, ...]:
    if min(sides, default=0) < 0:
        raise ValueError("a side is less than nothing")
    return tuple(sides)


def describe_array(name: str, array: NDArray[Any], unit: str) -> dict[str, Any]:
    """An entry of the header's `arrays`."""
    return {"name": name, "dtype": array.dtype.newbyteorder("<").str, "shape": list(array.shape), "unit": unit}


def frame_facts(tag: Tag, law: str | None) -> dict[str, Any]:
    """What every header that speaks of one frame holds."""
    return {
        "frame": tag.index,
        "utc_ns": tag.utc_ns,
        "pose": pose_face(tag),
        "focal_length_mm": tag.focal_length_mm,
        "f_number": tag.f_number,
        "camera": tag.camera,
        "mask": tag.mask,
        "law": law,
        "sha256": tag.frame_sha256,
    }


def pose_face(tag: Tag) -> dict[str, Any]:
    """The pose as people and maps read it: degrees, and roll, pitch, yaw of the vehicle beside the quaternion."""
    pose = tag.pose
    roll, pitch, yaw = euler(pose.attitude) if pose.attitude else (None, None, None)
    return {
        "source": pose.source,
        "utc_ns": pose.utc_ns,
        "utc_sigma_ns": tag.utc_sigma_ns,
        "latitude_deg": degrees(pose.latitude_rad),
        "longitude_deg": degrees(pose.longitude_rad),
        "altitude_msl_m": pose.altitude_msl_m,
        "height_above_home_m": pose.height_above_home_m,
        "velocity_ned_m_s": list(pose.velocity_ned_m_s) if pose.velocity_ned_m_s else None,
        "attitude": list(pose.attitude) if pose.attitude else None,
        "roll_deg": degrees(roll),
        "pitch_deg": degrees(pitch),
        "yaw_deg": degrees(yaw),
        "position_sigma_m": pose.position_sigma_m,
        "attitude_sigma_deg": degrees(pose.attitude_sigma_rad),
        "age_ms": pose.age_ms,
    }


def degrees(angle_rad: float | None) -> float | None:
    """An angle as people read it; unknown stays unknown."""
    return None if angle_rad is None else math.degrees(angle_rad)


def euler(q: Sequence[float]) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a body-to-NED quaternion (w, x, y, z); yaw from 0 to 2π."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw % (2 * math.pi)


def encode(header: Mapping[str, Any]) -> bytes:
    """A header's bytes. NaN has no place in JSON: unknown is null."""
    return json.dumps(header, separators=(",", ":"), allow_nan=False).encode()


def decode(parts: Sequence[Any]) -> Message:
    """A message from its parts. Raises WireError for anything else."""
    try:
        topic, header = bytes(parts[0]).decode(), json.loads(bytes(parts[1]))
    except (IndexError, ValueError, RecursionError) as error:  # ValueError: no UTF-8, no JSON, a number without end
        raise WireError(f"not a dappled message: {error}") from None
    if not isinstance(header, dict):
        raise WireError("not a dappled message: the header is no JSON object")
    return Message(topic, header, parts[2] if len(parts) > 2 else None)


def schema(topic: str) -> dict[str, Any]:
    """The JSON Schema of a topic's header."""
    text = (resources.files("dappled.daemon.stream") / "schemas" / f"{topic}.json").read_text(encoding="utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded
