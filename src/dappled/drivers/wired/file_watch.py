"""Watch a source for new files, and find the shot of each: for cameras whose shutter and files are not connected.

Files that come while their shots wait for them are attributed by order and by the camera's own time (`attribution`).
Files that come later are matched with all shots at once (`matching`).
"""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator

from dappled import findings
from dappled.clock import Clock
from dappled.drivers.attribution import BodyClock, Claim, FileClue, attribute
from dappled.drivers.camera import Arrival, CameraError, Companion, ShotFailed
from dappled.drivers.wired import matching
from dappled.drivers.wired.sources import FileGroup, FileSource, FoundFile, groups

_LATE = 64
_ENOUGH = 3
"""This many pairs, and no shot without one, identify a card that was not seen before the flight as this camera's."""


class FileWatch:
    """Watch a source. Files that were there before the first shot are older than the flight. One thread looks.

    `in_flight`: each file comes within `file_s` of its shot's release, or the shot is given up; a JPEG waits `pair_s`
    for the raw file beside it. Otherwise files may come at any time, and only certain ones are taken.
    """

    def __init__(self, source: FileSource, clock: Clock, *, in_flight: bool, file_s: float, pair_s: float) -> None:
        self._source, self._clock = source, clock
        self._in_flight, self._file_s, self._pair_s = in_flight, file_s, pair_s
        self._lock = threading.Lock()
        self._claims: list[Claim] = []
        self._late: list[Claim] = []
        self._body_clock = BodyClock()
        self._done: set[str] | None = None
        self._old: frozenset[str] | None = None  # the files from before the first shot, as long as they are there
        self._before: dict[str, int] = {}
        self._dates: dict[FoundFile, float | None] = {}
        self._weighed: tuple[list[Claim], list[FileGroup]] | None = None  # matched last: the same again gives no more
        self._trouble = ""  # why nothing could be listed, at the last look
        self._first_seen: dict[str, int] = {}
        self._stems: dict[str, int] = {}  # delivered frames by stem: for companions that come after

    def expect(self, claim: Claim) -> None:
        """A shot was fired; its file may come."""
        with self._lock:
            self._claims.append(claim)

    def look(self) -> Iterator[Arrival | Companion]:
        """List the source and yield each new and complete file. Raises what a source raises besides CameraError."""
        self._trouble = ""
        try:
            found = self._source.list()
        except CameraError as error:
            self._trouble = str(error)
            found = []
            self._old = self._old or None  # an empty card that went can't be told from another one
        else:
            names = frozenset(one.name for one in found)
            if self._done is None and not self._claims:
                self._done, self._old = set(names), names
            if self._old is not None and not self._old <= names:
                self._old = None  # another card
            yield from self._take(found)
        self._before = {one.name: one.size for one in found}

    def overdue(self) -> list[ShotFailed]:
        """Give up the shots that waited too long for a file in flight. A file that comes after all is marked."""
        if not self._in_flight:
            return []
        now_ns = self._clock.monotonic_ns()
        limit_ns = now_ns - round(self._file_s * 1e9)
        with self._lock:
            overdue = [claim for claim in self._claims if claim.fired_ns < limit_ns]
            self._claims = [claim for claim in self._claims if claim.fired_ns >= limit_ns]
        self._late = [*self._late, *overdue][-_LATE:]
        reason = f"no file came within {self._file_s:g} s of the release"
        reason += f": {self._trouble}" if self._trouble else ""
        return [ShotFailed(claim.shot, reason, now_ns) for claim in overdue]

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def _take(self, found: list[FoundFile]) -> Iterator[Arrival | Companion]:
        done = self._done = self._done or set()
        fresh = [one for one in found if one.name not in done]
        whole = [one for one in fresh if one.size > 0 and self._before.get(one.name) == one.size]
        if self._in_flight:
            for group in groups(whole):
                if self._complete(group):
                    yield from self._bring_in_flight(group)
        elif whole and len(whole) == len(fresh):  # nothing is still being written: now order and count mean something
            yield from self._match(groups(whole))

    def _complete(self, group: FileGroup) -> bool:
        """Whether no raw file can be expected beside it any more."""
        now_ns = self._clock.monotonic_ns()
        first_ns = self._first_seen.setdefault(group.main.stem, now_ns)
        waited = now_ns - first_ns >= self._pair_s * 1e9
        return group.main.raw or group.main.stem in self._stems or waited

    def _bring_in_flight(self, group: FileGroup) -> Iterator[Arrival | Companion]:
        """Attribute a file that comes while shots wait for theirs."""
        main = group.main
        if main.stem in self._stems:
            yield from self._accompany(self._stems[main.stem], (main, *group.companions))
            return
        try:
            taken_s = self._source.taken_s(main)
        except CameraError:
            return  # the next look may find it again
        with self._lock:
            waiting = list(self._claims)
        clue = FileClue(taken_s, self._first_seen[main.stem])
        found = attribute(clue, self._late, waiting, self._body_clock)
        facts = {"doubt": findings.text(found.doubt)} if found.doubt else {}
        if (yield from self._bring(found.shot, group, facts)):
            self._body_clock = found.clock
            self._late = [] if found.doubt else [one for one in self._late if one.shot != found.shot]

    def _match(self, fresh: list[FileGroup]) -> Iterator[Arrival | Companion]:
        """Match a card's files with all shots that wait, and take the pairs that are certain.

        A card that was not seen before the flight may hold files of any day and any camera: then every shot must have
        found its file, and there must be enough of them. The rest is left to `dappled flight pickup`.
        """
        with self._lock:
            claims = list(self._claims)
        if not claims or self._weighed == (claims, fresh):
            return
        try:
            for group in fresh:
                if group.main not in self._dates:
                    self._dates[group.main] = self._source.taken_s(group.main)
        except CameraError:
            return  # the card is gone again
        dated = [matching.DatedFile(group.main.name, self._dates[group.main]) for group in fresh]
        to_utc_ns = self._clock.utc_ns() - self._clock.monotonic_ns()
        shots = [matching.FiredShot(claim.shot, (claim.fired_ns + to_utc_ns) / 1e9) for claim in claims]
        by_name = {group.main.name: group for group in fresh}
        matched = matching.match(shots, dated)
        sure = self._old is not None or (not matched.shots and len(matched.pairs) >= _ENOUGH)
        brought = True
        for shot, name in matched.pairs if sure else ():
            brought = (yield from self._bring(shot, by_name[name], {})) and brought
        if brought:
            self._weighed = claims, fresh

    def _bring(
        self, shot: int | None, group: FileGroup, facts: dict[str, str]
    ) -> Generator[Arrival | Companion, None, bool]:
        """Yield a frame and its companions. Returns False where the frame can't be opened now."""
        try:
            blob = self._source.open(group.main)
        except CameraError:
            return False  # the next look may find it again
        assert self._done is not None
        self._done.add(group.main.name)
        self._first_seen.pop(group.main.stem, None)
        with self._lock:
            self._claims = [claim for claim in self._claims if claim.shot != shot]
        yield Arrival(shot, group.main.base, blob, self._clock.monotonic_ns(), {"name": group.main.name, **facts})
        if shot is not None:
            self._stems[group.main.stem] = shot
            yield from self._accompany(shot, group.companions)
        return True

    def _accompany(self, shot: int, files: tuple[FoundFile, ...]) -> Iterator[Companion]:
        assert self._done is not None
        for one in files:
            try:
                blob = self._source.open(one)
            except CameraError:
                continue
            self._done.add(one.name)
            yield Companion(shot, one.base, blob, self._clock.monotonic_ns(), {"name": one.name})
