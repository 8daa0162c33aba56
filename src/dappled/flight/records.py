"""The records of a flight, as immutable values. An unknown value is None.

One number, the image index, names a shot, the frame that it became, its file, and its CAMERA_IMAGE_CAPTURED. It goes
on over restarts. A shot that failed keeps its index.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal

from dappled import codec, findings
from dappled.decode.geometry import Pose
from dappled.findings import Finding

ShotState = Literal["wished", "fired", "safe", "failed"]
DOUBT, LATER_DOUBT = "doubt", "later doubt"
"""Kinds of events that hold a finding: a frame may be another shot's. The first kind came with its file and is in its
tag; the second was found after that."""
NOTICED = "noticed"
"""A kind of events that hold a finding: what a driver said of the camera's card."""
LEFT = "left"
"""A kind of events that hold a finding: a safe frame was not tagged, or not decoded."""
BEGAN, ENDED = "began", "ended"
"""Kinds of events that hold a finding of the service above a note: it began to stand or rose, or was over."""
REFUSED, LOST = "refused", "lost trigger"
"""Kinds of events that hold a finding: requests that became no shot, with their number `times` and their source as
subject; triggers of the autopilot that became no request."""
CUT_SHORT = "cut_short"
"""A fact of a flight that was not ended in order: within how many seconds of its end accepted shots (`shots_s`) and
refused requests (`refusals_s`) may have been lost."""


class TimeSource(StrEnum):
    """What a frame's time was taken from."""

    HOT_SHOE = "hot shoe"
    """A contact, by the autopilot's clock."""
    RECEIVER_MARK = "receiver mark"
    """A contact, by the clock of a GNSS receiver on this machine."""
    LOGGED_MARK = "logged mark"
    """A contact, by a receiver's own log, computed after the flight."""
    AUTOPILOT_TRIGGER = "autopilot trigger"
    """The autopilot's command to fire, and the body's latency."""
    TRIGGER_CALL = "trigger call"
    """Our own command to fire, and the body's latency."""
    REQUEST = "request"
    """The capture request, and the body's latency."""
    CAMERA_CLOCK = "camera clock"
    """EXIF, by the offset that other shots showed."""
    GIVEN = "given"
    """What a person said."""

    @property
    def contact(self) -> bool:
        """Whether a contact in the hot shoe was timed in flight."""
        return self in (TimeSource.HOT_SHOE, TimeSource.RECEIVER_MARK)


@dataclass(frozen=True, slots=True)
class Cause:
    """Who requested a shot. `source` is "mavlink:255/190", "console", "replay" …; `kind` the message or action."""

    source: str
    kind: str
    sequence: int | None = None


@dataclass(frozen=True, slots=True)
class Shot:
    """One capture request, with its cause. The times are those of the daemon's clocks when the request came."""

    index: int
    cause: Cause
    wished_utc_ns: int
    wished_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class Frame:
    """The file that the camera delivered for a shot, safe on disk. `name` is relative to the flight folder."""

    index: int
    name: str
    camera_name: str
    size: int
    sha256: str
    arrived_utc_ns: int


@dataclass(frozen=True, slots=True)
class Tag:
    """What is known of a frame apart from its pixels. `utc_ns` is mid-exposure; sigmas are one standard deviation.
    `doubts` are those about its time, and whose picture it is."""

    index: int
    utc_ns: int
    utc_sigma_ns: int
    time_source: TimeSource
    focal_length_mm: float | None
    f_number: float | None
    exposure_s: float | None
    iso: float | None
    camera: str
    mask: str
    frame_sha256: str
    pose: Pose
    doubts: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class ShotRow:
    """A shot and its state. The fired times are those before and after the trigger call; None where there was none.

    `reason` is why it failed, or what its file waits for; None for every other state.
    """

    shot: Shot
    state: ShotState
    reason: Finding | None
    fired_called_monotonic_ns: int | None
    fired_returned_monotonic_ns: int | None


@dataclass(frozen=True, slots=True)
class Judgement:
    """How a frame was judged in flight: good, usable, bad or unknown; why it isn't good; by what it was judged."""

    state: str
    reasons: tuple[Finding, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """The result of decoding a frame. `run` is "live" for the flight itself; later runs have names of their own.

    `slices_sha256` is the hash of the published body. `decode_ms` is None where it was not measured,
    `carriers_found` where no carriers can be seen at the frame's aperture.
    """

    index: int
    slices_sha256: str
    carriers_found: int | None
    carriers_predicted: int
    law: str
    carriers_from: str
    decode_ms: float | None = None
    run: str = "live"
    details: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def verdict(self) -> Judgement | None:
        """How the frame was judged in flight, and why; None where it was not, or where what stands there is none (a
        flight's check finds such a row by its digest)."""
        try:
            return codec.read(Judgement, self.details["verdict"])
        except (KeyError, codec.CodecError):
            return None

    @property
    def mask_nats(self) -> float | None:
        """The log odds that the mask is where it was calibrated; None where nothing tells."""
        nats = self.details.get("mask_nats")
        return float(nats) if isinstance(nats, int | float) else None


@dataclass(frozen=True, slots=True)
class Stray:
    """A file that belongs to no shot, or is a second file of one. It is kept, with the reason."""

    name: str
    camera_name: str
    size: int
    sha256: str
    arrived_utc_ns: int
    reason: Finding | None


@dataclass(frozen=True, slots=True)
class LedgerEvent:
    """Something that happened, as the ledger holds it: the JSON of a finding. `index` is the shot's, where there is
    one."""

    number: int
    utc_ns: int
    kind: str
    index: int | None
    text: str

    @property
    def finding(self) -> Finding | None:
        """What was found; None where that can't be read."""
        return findings.of_json_text(self.text)

    @property
    def words(self) -> str:
        """It as a person reads it."""
        found = self.finding
        return self.text if found is None else str(findings.told(found))
