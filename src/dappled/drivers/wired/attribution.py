"""Which shot made a file, when more than one may have: told by the body's own clock, else marked as doubtful.

A file may come after its shot was given up. It must not become the next shot's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

TOLERANCE_S = 3.0
"""A body's time has whole seconds, and is that of the exposure or of the writing of the file."""
_KEPT = 16


@dataclass(frozen=True, slots=True)
class Claim:
    """A shot that may have made a file: it was fired (`monotonic_ns` of the trigger call), and has none yet."""

    shot: int
    fired_ns: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """The shot that made a file, None where that can't be said; a sentence where there is doubt."""

    shot: int | None
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class BodyClock:
    """The body's time minus ours, in seconds, as the files of shots without rivals showed it (the last 16)."""

    offsets_s: tuple[float, ...] = ()

    def learnt(self, claim: Claim, taken_s: int) -> BodyClock:
        """With one more file whose shot is certain. One that doesn't fit begins anew: the body's clock was set."""
        kept = self.offsets_s if self.offsets_s and self.fits(claim, taken_s) else ()
        return BodyClock((*kept, taken_s - claim.fired_ns / 1e9)[-_KEPT:])

    def fits(self, claim: Claim, taken_s: int) -> bool:
        """Whether the file may be of this shot. Only to be asked when something was learnt."""
        return abs(taken_s - claim.fired_ns / 1e9 - median(self.offsets_s)) <= TOLERANCE_S


def attribute(late: Sequence[Claim], current: Claim | None, taken_s: int | None, clock: BodyClock) -> Verdict:
    """Whose file it is. `late` are shots that were given up after they had been fired, `current` the one that is waited
    for. Without rivals, and without a time that says otherwise, the file is the current shot's."""
    claims = [*late, *([] if current is None else [current])]
    if not claims:
        return Verdict(None)
    if taken_s is not None and clock.offsets_s:
        fitting = [claim for claim in claims if clock.fits(claim, taken_s)]
        if len(fitting) == 1:
            return Verdict(fitting[0].shot)
        if not fitting and current is None:
            return Verdict(None, "by the body's clock it is no shot's")
        claims = fitting or claims
    if len(claims) == 1:
        told = current is not None and not late
        return Verdict(claims[0].shot, "" if told else _rivals(claims))
    return Verdict(current.shot if current in claims and current is not None else None, _rivals(claims))


def _rivals(claims: Sequence[Claim]) -> str:
    shots = " or ".join(str(claim.shot) for claim in claims)
    return f"it may be the file of shot {shots}: one had been given up, and the body's clock doesn't tell them apart"
