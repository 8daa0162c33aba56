"""Rows of the ledger that are about the recording itself, as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dappled.flight.records import Shot, ShotState


@dataclass(frozen=True, slots=True)
class ShotRow:
    """A shot and how far it came. The fired times bracket the trigger call; None where it was not seen to fire.

    `reason` is a sentence, for a failed shot.
    """

    shot: Shot
    state: ShotState
    reason: str | None
    fired_called_monotonic_ns: int | None
    fired_returned_monotonic_ns: int | None


@dataclass(frozen=True, slots=True)
class Result:
    """What decoding made of a frame. `run` is "live" for the flight itself; other runs stand beside it.

    `slices_sha256` is that of the published body. `decode_ms` is None where nobody measured it.
    """

    index: int
    slices_sha256: str
    carriers_found: int
    carriers_predicted: int
    law: str
    carriers_from: str
    decode_ms: float | None = None
    run: str = "live"
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stray:
    """A file that belongs to no shot or is one too many: kept, with the reason."""

    name: str
    camera_name: str
    size: int
    sha256: str
    arrived_utc_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in words. `index` is the shot's, where there is one."""

    number: int
    utc_ns: int
    kind: str
    index: int | None
    text: str
