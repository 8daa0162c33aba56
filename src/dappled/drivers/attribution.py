"""Attribute a camera's file to the shot that made it, and correct its name by its content.

A file may come after its shot was given up; it must not become the next shot's frame. The body's own clock
distinguishes the shots. Where it can't, the file is marked as doubtful.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

TOLERANCE_S = 3.0
"""A body's time has whole seconds, and is the time of the exposure or of the writing of the file."""
_KEPT = 16
_DNG_VERSION = 50706


@dataclass(frozen=True, slots=True)
class Claim:
    """A shot that may have made a file: it was fired (monotonic time of the trigger call), and has no file yet."""

    shot: int
    fired_ns: int


@dataclass(frozen=True, slots=True)
class Attribution:
    """The shot that made a file, None where that is unknown; a sentence where there is doubt."""

    shot: int | None
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class BodyClock:
    """The body's time minus this machine's, in seconds, from the last 16 files whose shot was certain."""

    offsets_s: tuple[float, ...] = ()

    def learnt(self, claim: Claim, taken_s: int) -> BodyClock:
        """Add a file whose shot is certain. If it doesn't fit the earlier ones, drop them: the body's clock was set."""
        kept = self.offsets_s if self.offsets_s and self.fits(claim, taken_s) else ()
        return BodyClock((*kept, taken_s - claim.fired_ns / 1e9)[-_KEPT:])

    def fits(self, claim: Claim, taken_s: int) -> bool:
        """Whether this shot may have made the file. Needs at least one offset."""
        return abs(taken_s - claim.fired_ns / 1e9 - median(self.offsets_s)) <= TOLERANCE_S


def attribute(late: Sequence[Claim], current: Claim | None, taken_s: int | None, clock: BodyClock) -> Attribution:
    """Find the shot that made a file.

    `late` are shots that were given up after they had been fired; `current` is the one whose file is awaited. The file
    is the current shot's where there are no late ones and the body's time does not exclude it.
    """
    claims = [*late, *([] if current is None else [current])]
    if not claims:
        return Attribution(None)
    if taken_s is not None and clock.offsets_s:
        fitting = [claim for claim in claims if clock.fits(claim, taken_s)]
        if len(fitting) == 1:
            return Attribution(fitting[0].shot)
        if not fitting and current is None:
            return Attribution(None, "by the body's clock no shot that lacks a file made it")
        claims = fitting or claims
    if len(claims) == 1:
        certain = current is not None and not late
        return Attribution(claims[0].shot, "" if certain else _rivals(claims))
    return Attribution(current.shot if current in claims and current is not None else None, _rivals(claims))


def _rivals(claims: Sequence[Claim]) -> str:
    shots = " or ".join(str(claim.shot) for claim in claims)
    return f"it may be the file of shot {shots}: one had been given up, and the body's clock doesn't distinguish them"


def true_name(name: str, head: bytes) -> str:
    """Give a file's name the extension that its first bytes call for.

    libgphoto2 invents the names of pictures from the camera's memory, by a format code that does not include DNG.
    """
    suffix = _suffix(head)
    stem, dot, given = name.rpartition(".")
    if suffix is None or not dot or given.lower() == suffix:
        return name
    return f"{stem}.{suffix.upper() if given.isupper() else suffix}"


def _suffix(head: bytes) -> str | None:
    if head.startswith(b"\xff\xd8\xff"):
        return "jpg"
    if head.startswith(b"FUJIFILMCCD-RAW"):
        return "raf"
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
    if order is None or len(head) < 16:
        return None
    if head[8:10] == b"CR":
        return "cr2"
    (first,) = struct.unpack_from(order + "I", head, 4)
    if first + 2 > len(head):
        return None
    (count,) = struct.unpack_from(order + "H", head, first)
    last = min(first + 2 + 12 * count, len(head) - 1)
    tags = {struct.unpack_from(order + "H", head, at)[0] for at in range(first + 2, last, 12)}
    return "dng" if _DNG_VERSION in tags else None
