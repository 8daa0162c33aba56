"""The messages of the stream: multipart [topic, header, body?], their headers, and the questions of subscribers.

A header is one JSON object, a body holds the arrays that the header describes, end to end. docs/wire.md is the
description for other programs.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dappled import __version__, codec
from dappled.bounds import claims
from dappled.bounds.parsing import parse_json
from dappled.config.settings import PublishSettings
from dappled.errors import DappledError
from dappled.findings import Finding
from dappled.flight import Frame, Tag

VERSION = 1
TOPICS = ("start", "frame", "slices", "depth", "preview", "picture", "health", "end")
USUAL = tuple(topic for topic in TOPICS if topic != "picture")  # what comes unasked: a picture is made for a subscriber
CAN_BE_ASKED = ("start", "frame", "slices")
QUESTION_KEYS = ("get", "frame", "seq", "flight")
_FLIGHT_CHARACTERS = 200
_LAST_FRAME = 2**31 - 1  # MAVLink's image index
_HEADER_BYTES, _QUESTION_BYTES = 1 << 20, 1 << 12
_NUMBERS = re.compile(r"[<>|=]?[fciub](1|2|4|8|16)")


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
                dtype, shape = _number_type(entry["dtype"]), tuple(entry["shape"])
                size = dtype.itemsize * claims.count(shape, str(entry["name"])[:40])
                if start + size > len(data):
                    raise WireError(f"the body of {self.topic} ends inside array {entry['name']!r}")
                found[entry["name"]] = np.frombuffer(data[start : start + size], dtype).reshape(shape)
                start += size
        except (KeyError, TypeError, ValueError) as error:
            raise WireError(f"the arrays of {self.topic} don't match their description: {error}") from None
        return found


def _number_type(name: object) -> np.dtype[Any]:
    if not isinstance(name, str) or not _NUMBERS.fullmatch(name):
        raise ValueError("a dtype is not of numbers")
    return np.dtype(name)


def describe_array(name: str, array: NDArray[Any], unit: str) -> dict[str, Any]:
    """An entry of the header's `arrays`."""
    return {"name": name, "dtype": array.dtype.newbyteorder("<").str, "shape": list(array.shape), "unit": unit}


class DecodedSlices(Protocol):
    """What the header of a `slices` message says of a decoded frame."""

    @property
    def law(self) -> str:
        """The carrier law's name."""

    @property
    def carriers(self) -> list[list[float]]:
        """Rows [ky, kx, fy, fx]."""

    @property
    def carriers_from(self) -> str:
        """How the carriers' frequencies were found."""

    @property
    def carriers_found(self) -> int | None:
        """How many of the predicted carriers were seen in the frame; None where none can be seen at its aperture."""

    @property
    def grid(self) -> list[list[float]]:
        """(2, 3), from (y, x, 1) of a slice to sensor (row, column)."""

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What may be wrong with the frame."""

    @property
    def seen(self) -> Mapping[str, Any]:
        """Further entries of the `slices` schema, for viewers."""

    @property
    def sha256(self) -> str:
        """Of the body."""

    @property
    def arrays(self) -> list[dict[str, Any]]:
        """As `describe_array` gives them."""


def start_header(publish: PublishSettings, utc_ns: int, *, camera: str, mask: str) -> dict[str, object]:
    """The header of a `start` message."""
    return {
        "utc_ns": utc_ns,
        "software": f"dappled {__version__}",
        "camera": camera,
        "mask": mask,
        "slices": publish.slices,
        "ask": publish.ask,
    }


def slices_header(tag: Tag, decoded: DecodedSlices) -> dict[str, object]:
    """The header of a `slices` message, live or in an answer."""
    return {
        **frame_facts(tag, decoded.law),
        "carriers": decoded.carriers,
        "carriers_from": decoded.carriers_from,
        "carriers_found": decoded.carriers_found,
        "grid": decoded.grid,
        **decoded.seen,
        "doubts": codec.plain(decoded.doubts),
        "slices_sha256": decoded.sha256,
        "arrays": decoded.arrays,
    }


def frame_header(tag: Tag, frame: Frame, law: str | None) -> dict[str, object]:
    """The header of a `frame` message, live or in an answer."""
    return {
        **frame_facts(tag, law),
        "utc_sigma_ns": tag.utc_sigma_ns,
        "time_source": tag.time_source,
        "time_doubts": codec.plain(tag.doubts),
        "exposure_s": tag.exposure_s,
        "iso": tag.iso,
        "name": frame.name,
        "size": frame.size,
    }


def frame_facts(tag: Tag, law: str | None) -> dict[str, Any]:
    """The entries that all headers about one frame share."""
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
    """A pose for people and maps: degrees, and the vehicle's roll, pitch and yaw beside the quaternion."""
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
        "height_above_ground_m": pose.ground.metres if pose.ground else None,
        "ground_source": pose.ground.source if pose.ground else None,
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
    """Radians to degrees; None stays None."""
    return None if angle_rad is None else math.degrees(angle_rad)


def euler(q: Sequence[float]) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a body-to-NED quaternion (w, x, y, z); yaw from 0 to 2π."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw % (2 * math.pi)


def encode(header: Mapping[str, Any]) -> bytes:
    """A header's bytes. Raises ValueError for NaN, which JSON does not have: an unknown value is null."""
    return json.dumps(header, separators=(",", ":"), allow_nan=False).encode()


def decode(parts: Sequence[Any]) -> Message:
    """A message from its parts. Raises WireError for anything else."""
    try:
        topic, header = bytes(parts[0]).decode(), parse_json(parts[1], _HEADER_BYTES)
    except (IndexError, ValueError) as error:  # ValueError: no UTF-8, no JSON, or more than is read
        raise WireError(f"not a dappled message: {error}") from None
    if not isinstance(header, dict):
        raise WireError("not a dappled message: the header is not a JSON object")
    return Message(topic, header, parts[2] if len(parts) > 2 else None)


def parse_question(payload: Sequence[bytes]) -> dict[str, Any]:
    """A subscriber's question: one JSON object with `get` and, except for the start, `frame` or `seq`.

    Returns its known keys only, because the answer's header repeats them. Raises WireError.
    """
    try:
        request = parse_json(payload[0], _QUESTION_BYTES) if len(payload) == 1 else None
    except ValueError:
        request = None
    if not isinstance(request, dict):
        raise WireError('a question must be one JSON object such as {"get": "slices", "frame": 42}')
    if request.get("get") not in CAN_BE_ASKED:
        raise WireError(f'a question\'s "get" must be one of {", ".join(CAN_BE_ASKED)}')
    if request["get"] != "start":
        numbers = [request[name] for name in ("frame", "seq") if name in request]
        if not numbers or not all(type(number) is int and 0 <= number <= _LAST_FRAME for number in numbers):
            raise WireError("a question must name a frame (or, for slices, a seq) by a whole number, 0 or more")
    flight = request.get("flight")
    if flight is not None and not (isinstance(flight, str) and len(flight) <= _FLIGHT_CHARACTERS):
        raise WireError("a question's flight must be a name")
    return {name: request[name] for name in QUESTION_KEYS if name in request}
