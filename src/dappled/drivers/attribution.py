"""Attribute a camera's file to the shot that made it, and correct its name by its content.

`attribute` is the one rule for all drivers: a pure function from what is known of a file, of the shots that lack one
and of the body's clock to a shot, a shot with a doubt, or no shot: a stray. A file is never a shot's only because no
other shot is left: where the body's own time speaks against it, it is a stray, or in doubt.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median, pstdev

from dappled.findings import Code, Finding, Subject, finding

TOLERANCE_S = 3.0
"""A body's time has whole seconds, or two, and is the time of the exposure or of the writing of the file."""
_LEAST_S = 1.5
"""Two times in whole seconds differ by less than one, and the shutter's latencies by some tenths."""
_SIGMAS = 4.0
_SLOW_S = 5.0
_SLOWER = 2.5
_FEW = 4
_KEPT = 16
_DNG_VERSION = 50706


@dataclass(frozen=True, slots=True)
class Claim:
    """A shot that may have made a file: it was fired (monotonic time of the trigger call), and has no file yet."""

    shot: int
    fired_ns: int


@dataclass(frozen=True, slots=True)
class FileClue:
    """What is known of a file whose shot is sought. Times of this machine are monotonic.

    `taken_s`: when it was made by the body's clock, which may be wrong; None where the body doesn't say. `arrived_ns`:
    when it was announced or first listed. `since_ns`: every picture made before is known already (None: unknown).
    `following`: how many files that were taken later came with it.
    `after` and `before`: the shots whose certain frames stand next to it by the camera's count of names, on the same
    card; None where there are none, or where names don't count.
    """

    taken_s: float | None
    arrived_ns: int
    since_ns: int | None = None
    after: int | None = None
    before: int | None = None
    following: int = 0


@dataclass(frozen=True, slots=True)
class RivalTime:
    """How far the body's time of a file was from a shot's, if it was that shot's; and of how many files before it, in a
    row, that was so far from theirs."""

    claim: Claim
    offset_s: float
    before: int = 0


@dataclass(frozen=True, slots=True)
class BodyClock:
    """The body's time minus this machine's, in seconds, from the last 16 files whose shot was certain.

    `rivals` are those of the last files, which disagreed with them, to each shot that they may be of: the body's clock
    may have been set.
    """

    offsets_s: tuple[float, ...] = ()
    rivals: tuple[RivalTime, ...] = ()

    @property
    def limit_s(self) -> float:
        """How far a file's time may be from its shot's: four standard deviations of those that are known, at least 1.5
        s and at most 3 s. Needs at least one offset."""
        return min(max(_SIGMAS * pstdev(self.offsets_s), _LEAST_S), TOLERANCE_S)

    def off_s(self, claim: Claim, taken_s: float) -> float:
        """How much later than this shot the file was made. Needs at least one offset."""
        return taken_s - claim.fired_ns / 1e9 - median(self.offsets_s)

    def fits(self, claim: Claim, taken_s: float) -> bool:
        """Whether this shot may have made the file. Needs at least one offset."""
        return abs(self.off_s(claim, taken_s)) <= self.limit_s

    def learnt(self, claim: Claim, taken_s: float) -> BodyClock:
        """With a file whose shot is certain. If it doesn't fit the earlier ones, the body's clock was set: only those
        that agree with it are kept."""
        new_s = taken_s - claim.fired_ns / 1e9
        known = self.offsets_s
        if known and abs(self.off_s(claim, taken_s)) > TOLERANCE_S:
            known = tuple(one.offset_s for one in self.rivals if abs(one.offset_s - new_s) <= TOLERANCE_S)
        return BodyClock((*known, new_s)[-_KEPT:])

    def rivalling(self, claims: Sequence[Claim], taken_s: float) -> list[tuple[RivalTime, float]]:
        """What a file says that would be of one of these shots only if the body's clock had been set, and how far it is
        from the file before it: the likeliest first."""
        found = []
        for claim in claims:
            new_s = taken_s - claim.fired_ns / 1e9
            near = [(abs(new_s - one.offset_s), one) for one in self.rivals if one.claim.fired_ns <= claim.fired_ns]
            apart_s, last = min(near, key=lambda one: one[0], default=(math.inf, None))
            agrees = last is not None and apart_s <= TOLERANCE_S
            found.append((RivalTime(claim, new_s, 1 + last.before if last and agrees else 0), apart_s))
        return sorted(found, key=lambda one: (-one[0].before, one[1]))


@dataclass(frozen=True, slots=True)
class FramedShot:
    """A shot whose frame has come, and when that was announced or first listed (monotonic)."""

    claim: Claim
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class Attribution:
    """The shot that made a file, None for a stray; what is known of the body's clock after it; and a finding where the
    shot is in doubt."""

    shot: int | None
    clock: BodyClock
    doubt: Finding | None = None


def attribute(clue: FileClue, late: Sequence[Claim], waiting: Sequence[Claim], clock: BodyClock) -> Attribution:
    """Find the shot that made a file.

    `waiting` are the shots whose files are awaited, in the order of firing; `late` are those that were given up after
    they had been fired. The caller keeps `clock` of the answer, and takes the shot out of both lists; after a doubt
    between shots no file of an older one is expected.

    By names, a file is of no shot before `clue.after` or behind `clue.before`. By the body's clock it is of a shot that
    it fits. Of several that fit, and where there is no clock, files come in order; a shot given up is a rival, and in
    doubt where its picture would be known already and no names confirm its place. A file that fits none is a picture of
    another moment, a stray, where it can have been made then: not before `since_ns` and not after the awaited shot was
    fired. Else the body was slow or its clock was set, and it is the awaited shot's, in doubt. The new time counts from
    the second such file in a row on; from the third, where they may be pictures by hand after shots without one.
    """
    claims = [one for one in (*late, *waiting) if _possible(one, clue)]
    awaited = next((one for one in waiting if one in claims), None)
    taken_s = clue.taken_s
    if not claims or taken_s is None or not clock.offsets_s:
        return _by_order(claims, awaited, late, clue, clock)
    if fitting := [one for one in claims if clock.fits(one, taken_s)]:
        found = _by_order(fitting, awaited, late, clue, clock)
        unseen = next((one for one in late if one.shot == found.shot and _would_be_known(one, clue)), None)
        return (
            found if unseen is None or found.doubt else Attribution(unseen.shot, clock, _unconfirmed(unseen, awaited))
        )
    nearest = min(claims, key=lambda one: abs(clock.off_s(one, taken_s)))
    if abs(clock.off_s(nearest, taken_s)) <= TOLERANCE_S:
        return Attribution(nearest.shot, clock.learnt(nearest, taken_s), _disagrees(nearest, taken_s, clock))
    if awaited is None:
        return Attribution(None, clock)
    rivalling = clock.rivalling([one for one in waiting if one in claims], taken_s)
    likely, apart_s = rivalling[0]
    alone = all(one.before < likely.before or other_s > apart_s + 1.0 for one, other_s in rivalling[1:])
    agreeing = likely.before + (not _of_another_moment(clue, awaited, taken_s, clock))
    chosen = likely.claim if likely.before else awaited
    by_hand = 0 < clock.off_s(chosen, taken_s) <= (clue.arrived_ns - chosen.fired_ns) / 1e9 + clock.limit_s
    needed = _FEW if len(rivalling) > 1 else 2 if by_hand else 1
    if agreeing > needed and alone and apart_s <= _LEAST_S:
        return Attribution(chosen.shot, clock.learnt(chosen, taken_s))
    doubt = _disagrees(chosen, taken_s, clock) if agreeing else None
    told = replace(clock, rivals=(*(one for one, _ in rivalling), *clock.rivals)[:_KEPT])
    return Attribution(chosen.shot if doubt else None, told, doubt)


def rivals(stray: str, clue: FileClue, framed: Sequence[FramedShot], clock: BodyClock) -> list[Finding]:
    """The doubts of frames that have come, which a stray of this name may be instead: it was made as their shot was.

    Where the body tells no time, or a frame is the only one by which its clock is known, what comes soon after the shot
    may be its picture: within 5 s, or two and a half times as long as the frame took.
    """
    taken_s, offsets = clue.taken_s, clock.offsets_s

    def may_be(one: FramedShot) -> bool:
        fired_ns = one.claim.fired_ns
        if taken_s is not None and offsets and abs(clock.off_s(one.claim, taken_s)) <= _LEAST_S:
            return True
        soon_ns = max(_SLOW_S * 1e9, _SLOWER * (one.arrived_ns - fired_ns))
        return (taken_s is None or len(offsets) < 2) and 0 <= clue.arrived_ns - fired_ns <= soon_ns

    return [
        finding(Code.FRAME_RIVAL_PICTURE, Subject("frame", one.claim.shot), picture=stray)
        for one in framed
        if may_be(one)
    ]


def _possible(claim: Claim, clue: FileClue) -> bool:
    if claim.fired_ns > clue.arrived_ns:
        return False
    return (clue.after is None or claim.shot > clue.after) and (clue.before is None or claim.shot < clue.before)


def _by_order(
    claims: Sequence[Claim], awaited: Claim | None, late: Sequence[Claim], clue: FileClue, clock: BodyClock
) -> Attribution:
    """Choose among shots that the body's clock doesn't exclude: by time where it is known, else the awaited one."""
    taken_s = clue.taken_s
    dated_s = taken_s if clock.offsets_s else None
    rivals = [one for one in claims if one in late]
    chosen = awaited if awaited in claims else claims[0] if len(claims) == 1 else None
    if dated_s is not None and chosen is not None and not rivals and len(claims) > 1:
        nearest = min((one for one in claims if one != chosen), key=lambda one: abs(clock.off_s(one, dated_s)))
        off_s, nearest_s = (abs(clock.off_s(one, dated_s)) for one in (chosen, nearest))
        if off_s > _LEAST_S and nearest_s < off_s - 1.0:
            chosen = nearest  # the awaited shot's file is late, or there is none
        elif off_s > _LEAST_S and nearest_s < off_s + 1.0:
            subject = Subject("frame", chosen.shot)
            return Attribution(chosen.shot, clock, finding(Code.FRAME_RIVAL_SHOTS, subject, rival=nearest.shot))
    if dated_s is not None and rivals:
        chosen = min(claims, key=lambda one: abs(clock.off_s(one, dated_s)))
    if chosen is None:
        return Attribution(None, clock)
    subject = Subject("frame", chosen.shot)
    if rival := next((one for one in reversed(rivals if chosen not in rivals else claims) if one != chosen), None):
        return Attribution(chosen.shot, clock, finding(Code.FRAME_RIVAL_SHOTS, subject, rival=rival.shot))
    last = claims[max(len(claims) - 1 - clue.following, 0)]
    if not clock.offsets_s and chosen == awaited and _is_rather_of(last, chosen, clue.arrived_ns):
        return Attribution(chosen.shot, clock, finding(Code.FRAME_RIVAL_SHOTS, subject, rival=last.shot))
    if rivals and dated_s is None:
        return Attribution(chosen.shot, clock, _unconfirmed(chosen, None))
    return Attribution(chosen.shot, clock if taken_s is None else clock.learnt(chosen, taken_s))


def _would_be_known(claim: Claim, clue: FileClue) -> bool:
    """Whether this shot's picture was made before a time whose pictures are all known: the body's clock may have been
    set back to the time of this shot. Not where times run as the camera counts: a body may write a file late."""
    return clue.after is None and clue.since_ns is not None and claim.fired_ns + TOLERANCE_S * 1e9 < clue.since_ns


def _unconfirmed(chosen: Claim, awaited: Claim | None) -> Finding:
    subject = Subject("frame", chosen.shot)
    if awaited is not None:
        return finding(Code.FRAME_RIVAL_SHOTS, subject, rival=awaited.shot)
    return finding(Code.FRAME_UNCONFIRMED, subject, shot=chosen.shot)


def _is_rather_of(other: Claim, chosen: Claim, arrived_ns: int) -> bool:
    """Whether the first file came so soon after another shot, and so late after the chosen one, that this one may have
    made none: the body's clock can't tell yet."""
    waited_ns = arrived_ns - chosen.fired_ns
    return waited_ns > _SLOW_S * 1e9 and arrived_ns - other.fired_ns < waited_ns / 4


def _of_another_moment(clue: FileClue, awaited: Claim, taken_s: float, clock: BodyClock) -> bool:
    """Whether, by the body's clock as it was known, the file can have been made before the awaited shot was fired.

    Later than that it is rather this shot's, by a body that took its time to focus.
    """
    made_ns = (taken_s - median(clock.offsets_s)) * 1e9
    slack_ns = clock.limit_s * 1e9
    since_ns = made_ns if clue.since_ns is None else clue.since_ns
    return since_ns - slack_ns <= made_ns <= min(clue.arrived_ns, awaited.fired_ns) + slack_ns


def _disagrees(claim: Claim, taken_s: float, clock: BodyClock) -> Finding:
    off_s = clock.off_s(claim, taken_s)
    return finding(Code.FRAME_CLOCK_DISAGREES, Subject("frame", claim.shot), off_s=off_s)


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
