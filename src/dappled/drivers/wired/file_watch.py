"""Watch a source for new files, and find the shot of each: for cameras whose shutter and files are not connected.

Files that come while their shots wait for them are attributed by `attribution`. Files that come later are matched with
all shots at once (`matching`). A file is known by its name, size, time and card together, and by its bytes once they
were there: another card may number from 0001 again.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

from dappled import codec, durable, picture_order
from dappled.clock import Clock
from dappled.drivers.attribution import BodyClock, Claim, FileClue, FramedShot, attribute, rivals
from dappled.drivers.camera import Arrival, Blob, CameraError, Companion, Noticed, ShotFailed
from dappled.drivers.wired import matching
from dappled.drivers.wired.sources import FileGroup, FileSource, FoundFile, groups
from dappled.findings import Code, Subject, finding

_LATE = 64
_ENOUGH = 3
"""This many pairs, and no shot without one, identify a card that was not seen before the flight as this camera's."""
_BESIDE_S = 2.0
_COUNTED = re.compile(r"(?:.*/)?([A-Z0-9_]{4})[0-9]{4}\.[^./]*", re.IGNORECASE)

FileEvents = Iterator[Arrival | Companion | Noticed]


@dataclass(frozen=True, slots=True)
class BroughtFile:
    """A file that was delivered: its bytes' number and hash, when it was taken by the body's clock, and its shot."""

    file: FoundFile
    size: int
    sha256: str
    taken_s: float | None
    shot: int | None
    certain: bool


class FileWatch:
    """Watch a source. Files that were there before the first shot are older than the flight. One thread looks.

    `in_flight`: each file comes within `file_s` of its shot's release, or the shot is given up; a JPEG waits `pair_s`
    for the raw file beside it. Otherwise files may come at any time, and only certain ones are taken.
    """

    def __init__(self, source: FileSource, clock: Clock, *, in_flight: bool, file_s: float, pair_s: float) -> None:
        self._source, self._clock = source, clock
        self._in_flight, self._file_s, self._pair_s = in_flight, file_s, pair_s
        self._began_ns = clock.monotonic_ns()
        self._lock = threading.Lock()
        self._claims: list[Claim] = []
        self._late: list[Claim] = []
        self._framed: deque[FramedShot] = deque(maxlen=_LATE)  # the last shots whose frames have come
        self._past_ns = -1
        self._body_clock = BodyClock()
        self._done: set[FoundFile] = set()
        self._looked = False
        self._first: frozenset[FoundFile] | None = None  # the files from before the first shot
        self._before: frozenset[FoundFile] = frozenset()
        self._settled: frozenset[FoundFile] = frozenset()  # those that were there for two looks, of the last card
        self._card = ""
        self._away = False  # nothing could be listed since the last card was
        self._dates: dict[FoundFile, float | None] = {}
        self._weighed: tuple[list[Claim], list[FileGroup]] | None = None  # matched last: the same again gives no more
        self._trouble = ""  # why nothing could be listed, at the last look
        self._first_seen: dict[str, int] = {}
        self._brought: dict[str, BroughtFile] = {}  # by name
        self._frames: dict[str, BroughtFile] = {}  # by stem, of this card: for companions that come after
        self._left: list[FoundFile] = []

    def expect(self, claim: Claim) -> None:
        """A shot was fired; its file may come."""
        with self._lock:
            self._claims.append(claim)

    def look(self) -> FileEvents:
        """List the source and yield what is new: each complete file, and a card that was changed. Raises what a source
        raises besides CameraError."""
        self._trouble = ""
        try:
            found = self._source.list()
        except CameraError as error:
            self._trouble, self._away = str(error), True
            self._before = frozenset()
            if not self._first:
                self._first = None  # an empty card that went can't be told from another one
            return
        if not self._looked and not self._claims:
            self._done, self._first = set(found), frozenset(found)
        self._looked = True
        yield from self._recognise(found)
        yield from self._take(found)
        self._before = frozenset(found)

    def overdue(self) -> list[ShotFailed]:
        """Give up the shots that waited too long for a file in flight. A file that comes after all is marked."""
        if not self._in_flight:
            return []
        now_ns = self._clock.monotonic_ns()
        limit_ns = now_ns - round(self._file_s * 1e9)
        with self._lock:
            overdue = [claim for claim in self._claims if claim.fired_ns < limit_ns]
            self._claims = [claim for claim in self._claims if claim.fired_ns >= limit_ns]
        self._late = [*self._late, *(one for one in overdue if one.fired_ns > self._past_ns)][-_LATE:]
        reason = f"no file came within {self._file_s:g} s of the release"
        reason += f": {self._trouble}" if self._trouble else ""
        return [ShotFailed(claim.shot, reason, now_ns) for claim in overdue]

    def left(self) -> Iterator[Noticed]:
        """What stays on the card: pictures of this flight by name, how many may be of it, or that none can be seen."""
        now_ns = self._clock.monotonic_ns()
        if self._source.removable and self._away and self._claims:
            yield Noticed(finding(Code.CARD_NOT_LISTED, Subject("card")), now_ns)
        known, others = self._is_known_card(self._before), []
        for group in groups(self._left):
            name, taken_s = group.main.name, self._dates.get(group.main)
            if known or self._is_of_flight(taken_s, now_ns):
                yield Noticed(finding(Code.PICTURE_ON_CARD, Subject("picture", name)), now_ns)
            else:
                others.append(name)
        if others:
            subject, first = Subject("card"), others[0]
            yield Noticed(finding(Code.CARD_PICTURES_LEFT, subject, pictures=len(others), first=first), now_ns)

    def close(self) -> None:
        self._source.close()

    # cards

    def _recognise(self, found: list[FoundFile]) -> Iterator[Noticed]:
        """Tell a card that was changed: by its volume id, or because none of the files that it had are there."""
        now = frozenset(found)
        card = next((one.card for one in found if one.card), "")
        if not found:
            return
        if card and self._card:
            changed = card != self._card
        else:
            changed = self._source.removable and bool(self._settled) and not self._settled & now
        if self._away:
            changed = self._forget_others(now) or changed
        self._away = False
        self._card = card or self._card
        self._settled = now & self._before or (frozenset() if changed else self._settled & now)
        if changed:
            self._first_seen.clear()
            self._frames.clear()
            self._dates.clear()
            yield Noticed(finding(Code.CARD_CHANGED, Subject("card")), self._clock.monotonic_ns())

    def _forget_others(self, now: frozenset[FoundFile]) -> bool:
        """Take files for new that look like ones that were brought, but are of another time or have other bytes."""
        others = [one.file for one in self._brought.values() if one.file in now and not self._is_same(one)]
        self._done.difference_update(others)
        return bool(others)

    def _is_same(self, was: BroughtFile) -> bool:
        try:
            if was.taken_s is not None:
                return self._source.taken_s(was.file) == was.taken_s
            return _begins_with(self._source.open(was.file), was)
        except CameraError:
            return True  # it is gone again

    def _is_known_card(self, now: frozenset[FoundFile]) -> bool:
        """Whether these files lie on the card that was there before the first shot."""
        if self._first is None:
            return False
        old = next((one.card for one in self._first if one.card), "")
        return old == self._card if old and self._card else self._first <= now

    def _is_of_flight(self, taken_s: float | None, now_ns: int) -> bool:
        """Whether a picture was taken since the driver began, by the body's clock as it is known."""
        offsets_s = self._body_clock.offsets_s
        if taken_s is None or not offsets_s:
            return False
        return self._began_ns / 1e9 - matching.WINDOW_S <= taken_s - median(offsets_s) <= now_ns / 1e9

    # files

    def _take(self, found: list[FoundFile]) -> FileEvents:
        fresh = [one for one in found if one not in self._done]
        new = []
        for one in fresh:
            if one.size > 0 and one in self._before and not (yield from self._is_brought(one)):
                new.append(one)
        self._left = [one for one in fresh if one not in self._done]
        if self._in_flight:
            yield from self._take_in_flight(groups(new), found)
        elif new and len(new) == len(self._left):  # nothing is still being written: now order and count mean something
            yield from self._match(groups(new), frozenset(found))

    def _is_brought(self, one: FoundFile) -> Generator[Arrival | Companion | Noticed, None, bool]:
        """Whether a file is one that was delivered. Yields another version of it for the same shot."""
        was = self._brought.get(one.name)
        if was is None:
            return False
        try:
            same, taken_s = _begins_with(self._source.open(one), was), self._date(one)
        except CameraError:
            return True  # the next look may find it again
        if was.file.card != one.card and not (same and one.size == was.size):
            return False
        if not same and (taken_s is None or taken_s != was.taken_s):
            return False
        if not same or one.size != was.size:
            yield from self._bring(was.shot, FileGroup(one), {})
        self._done.add(one)
        return True

    def _take_in_flight(self, new: list[FileGroup], found: list[FoundFile]) -> FileEvents:
        try:
            dates = {group.main: self._date(group.main) for group in new}
        except CameraError:
            return  # the next look may find it again
        ordered = picture_order.by_time(new, lambda one: one.main.name, lambda one: dates[one.main]).items
        for place, group in enumerate(ordered, 1):
            now_ns = self._clock.monotonic_ns()
            first_ns = self._first_seen.setdefault(group.main.stem, now_ns)
            beside = self._beside(group.main, found)
            if beside is not None and beside.shot is not None:
                yield from self._accompany(beside.shot, (group.main, *group.companions))
            elif group.main.raw or beside is not None or now_ns - first_ns >= self._pair_s * 1e9:
                after, before = self._neighbours(group.main, dates[group.main], found)
                clue = FileClue(dates[group.main], first_ns, None, after, before, len(ordered) - place)
                yield from self._bring_in_flight(group, clue)

    def _beside(self, one: FoundFile, found: Iterable[FoundFile]) -> BroughtFile | None:
        """The frame of the same exposure that was brought before it: it has its stem and time, and is still there."""
        frame = self._frames.get(one.stem)
        if frame is None or frame.file.name == one.name or frame.file not in found:
            return None
        taken_s = self._dates.get(one)
        apart_s = 0.0 if taken_s is None or frame.taken_s is None else abs(taken_s - frame.taken_s)
        return frame if apart_s <= _BESIDE_S else None

    def _bring_in_flight(self, group: FileGroup, clue: FileClue) -> FileEvents:
        """Attribute a file that comes while shots wait for theirs."""
        with self._lock:
            waiting = [one for one in self._claims if one.fired_ns > self._past_ns]
        made = attribute(clue, self._late, waiting, self._body_clock)
        facts = {"doubt": codec.plain(made.doubt)} if made.doubt else {}
        if (yield from self._bring(made.shot, group, facts)):
            self._body_clock = made.clock
            framed = (one for one in (*self._late, *waiting) if one.shot == made.shot)
            self._framed.extend(FramedShot(one, clue.arrived_ns) for one in framed)
            doubts = rivals(group.main.name, clue, self._framed, made.clock) if made.shot is None else []
            for doubt in doubts:
                yield Noticed(doubt, self._clock.monotonic_ns())
            self._late = [] if made.doubt else [one for one in self._late if one.shot != made.shot]
            if made.doubt:  # files come in order: no file of an older shot is expected any more
                self._past_ns = max((one.fired_ns for one in waiting if one.shot == made.shot), default=self._past_ns)

    def _neighbours(
        self, file: FoundFile, taken_s: float | None, found: Iterable[FoundFile]
    ) -> tuple[int | None, int | None]:
        """The shots of the certain frames next to a file by the camera's count of names, unless its time contradicts
        that count."""
        series = _COUNTED.fullmatch(file.name)
        here = set(found)
        frames = [
            one
            for one in self._brought.values()
            if one.shot is not None and one.certain and one.file in here and one.file.name != file.name
            if series and (other := _COUNTED.fullmatch(one.file.name)) and other[1] == series[1]
        ]
        if not frames:
            return None, None
        this = BroughtFile(file, file.size, "", taken_s, None, certain=False)
        ordered = picture_order.by_name([*frames, this], lambda one: one.file.name)
        at = ordered.index(this)
        last, following = ordered[at - 1] if at else None, ordered[at + 1] if at + 1 < len(ordered) else None
        if (last and _is_later(last, this)) or (following and _is_later(this, following)):
            return None, None
        return last.shot if last else None, following.shot if following else None

    def _match(self, fresh: list[FileGroup], now: frozenset[FoundFile]) -> FileEvents:
        """Match a card's files with all shots that wait, and take the pairs that are certain.

        A card that was not seen before the flight may hold files of any day and any camera: then the body's clock must
        be known from earlier files, or every shot must have found its file, and there must be enough of them. The rest
        is left to `dappled flight pickup`.
        """
        with self._lock:
            claims = {claim.shot: claim for claim in self._claims}
        weighed = list(claims.values()), fresh
        if not claims or self._weighed == weighed:
            return
        try:
            dated = [matching.DatedFile(group.main.name, self._date(group.main)) for group in fresh]
        except CameraError:
            return  # the card is gone again
        to_utc_s = (self._clock.utc_ns() - self._clock.monotonic_ns()) / 1e9
        shots = [matching.FiredShot(claim.shot, claim.fired_ns / 1e9 + to_utc_s) for claim in claims.values()]
        offsets_s = self._body_clock.offsets_s
        matched = matching.match(shots, dated, offset_s=median(offsets_s) - to_utc_s if offsets_s else None)
        sure = bool(offsets_s) or self._is_known_card(now)
        rival = any(doubt.code is Code.PICTURE_RIVAL_SHOTS for doubt in matched.doubts)
        if not matched.pairs and offsets_s and not rival:  # the body's clock may have been set
            matched, sure = matching.match(shots, dated), False
        sure = sure or (not matched.shots and len(matched.pairs) >= _ENOUGH)
        by_name = {group.main.name: group for group in fresh}
        brought = True
        for shot, name in matched.pairs if sure else ():
            brought = (yield from self._bring(shot, by_name[name], {})) and brought
            taken_s = self._dates.get(by_name[name].main)
            if taken_s is not None:
                self._body_clock = self._body_clock.learnt(claims[shot], taken_s)
        if brought:
            self._weighed = weighed

    def _date(self, one: FoundFile) -> float | None:
        """When a file was taken, by the body's clock; read once. Raises CameraError."""
        if one not in self._dates:
            self._dates[one] = self._source.taken_s(one)
        return self._dates[one]

    def _bring(
        self, shot: int | None, group: FileGroup, facts: dict[str, Any]
    ) -> Generator[Arrival | Companion | Noticed, None, bool]:
        """Yield a frame and its companions. Returns False where the frame can't be read now."""
        main = group.main
        try:
            blob = self._source.open(main)
            sha256 = _sha256(blob, blob.size)
        except CameraError:
            return False  # the next look may find it again
        brought = BroughtFile(main, blob.size, sha256, self._dates.get(main), shot, certain="doubt" not in facts)
        self._done.add(main)
        self._brought[main.name] = brought
        self._first_seen.pop(main.stem, None)
        with self._lock:
            self._claims = [claim for claim in self._claims if claim.shot != shot]
        yield Arrival(shot, main.base, blob, self._clock.monotonic_ns(), {"name": main.name, **facts})
        if shot is not None:
            self._frames[main.stem] = brought
            yield from self._accompany(shot, group.companions)
        return True

    def _accompany(self, shot: int, files: tuple[FoundFile, ...]) -> Iterator[Companion]:
        for one in files:
            try:
                blob = self._source.open(one)
            except CameraError:
                continue
            self._done.add(one)
            yield Companion(shot, one.base, blob, self._clock.monotonic_ns(), {"name": one.name})


def _is_later(one: BroughtFile, other: BroughtFile) -> bool:
    """Whether a file was made after another, by the times in both or else those on both."""
    if one.taken_s is not None and other.taken_s is not None:
        return one.taken_s > other.taken_s
    return one.file.modified_ns > other.file.modified_ns


def _sha256(blob: Blob, size: int) -> str:
    """The hash of a blob's first bytes. Closes it, and raises CameraError, where it can't be read."""
    try:
        return durable.hash_descriptor(blob.fd, size)
    except (OSError, EOFError) as error:
        blob.close()
        raise CameraError(f"a file of the camera can't be read: {error}") from error


def _begins_with(blob: Blob, was: BroughtFile) -> bool:
    """Whether a file begins with the bytes that were delivered. Closes it. Raises CameraError."""
    if blob.size < was.size:
        blob.close()
        return False
    same = _sha256(blob, was.size) == was.sha256
    blob.close()
    return same
