"""Whose are the files that appear at a source? For cameras whose shutter and files know nothing of each other.

Files that come while their shots are waited for are told apart by order and by the camera's own time (`attribution`).
Files that only come later are matched with all shots at once (`matching`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from dappled.drivers.attribution import BodyClock, Claim, attribute
from dappled.drivers.camera import Arrival, CameraError, Companion
from dappled.drivers.wired import matching
from dappled.drivers.wired.sources import Found, Group, Source, groups

_LATE = 64
_ENOUGH = 3
"""So many pairs, and no shot without one, say that a card nobody saw before the flight is this camera's."""


class FileWatch:
    """Watches a source. What lay there before the first shot is older than the flight. One thread looks.

    `in_flight`: each file comes within `file_s` of its shot's release, or the shot is given up; a JPEG waits `pair_s`
    for the raw file beside it. Otherwise files come when they come, and only what is sure is taken.
    """

    def __init__(
        self,
        source: Source,
        deliver: Callable[[Arrival | Companion], None],
        give_up: Callable[[int, str], None],
        *,
        in_flight: bool,
        file_s: float,
        pair_s: float,
        clock_ns: Callable[[], int],
        utc_ns: Callable[[], int],
    ) -> None:
        """`deliver` is told each file, `give_up` each shot without one and what was wrong with the source."""
        self._source, self._in_flight, self._file_s, self._pair_s = source, in_flight, file_s, pair_s
        self._deliver, self._give_up, self._clock_ns, self._utc_ns = deliver, give_up, clock_ns, utc_ns
        self._lock = threading.Lock()
        self._claims: list[Claim] = []
        self._late: list[Claim] = []
        self._clock = BodyClock()
        self._done: set[str] | None = None
        self._old: frozenset[str] | None = None  # what lay there before the first shot, as long as it does
        self._before: dict[str, int] = {}
        self._dates: dict[Found, float | None] = {}
        self._weighed: tuple[list[Claim], list[Group]] | None = None  # what was matched last: again brings no more
        self._trouble = ""  # why nothing could be listed, at the last look
        self._first_seen: dict[str, int] = {}
        self._stems: dict[str, int] = {}  # delivered frames by stem: for companions that come after

    def expect(self, claim: Claim) -> None:
        """A shot was fired; its file may come."""
        with self._lock:
            self._claims.append(claim)

    def look(self) -> None:
        """Deliver what is new and whole; give up what was waited for too long, whatever the source does."""
        try:
            self._look()
        finally:
            self._bound()

    def _look(self) -> None:
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
            self._take(found)
        self._before = {one.name: one.size for one in found}

    def close(self) -> None:
        """Let go of the source."""
        self._source.close()

    def _take(self, found: list[Found]) -> None:
        done = self._done = self._done or set()
        fresh = [one for one in found if one.name not in done]
        whole = [one for one in fresh if one.size > 0 and self._before.get(one.name) == one.size]
        if self._in_flight:
            for group in groups(whole):
                if self._complete(group):
                    self._hand_over(group)
        elif whole and len(whole) == len(fresh):  # nothing is still being written: now order and count mean something
            self._match(groups(whole))

    def _complete(self, group: Group) -> bool:
        """Whether no raw file is to be expected beside it any more."""
        now_ns = self._clock_ns()
        first_ns = self._first_seen.setdefault(group.main.stem, now_ns)
        waited = now_ns - first_ns >= self._pair_s * 1e9
        return group.main.raw or group.main.stem in self._stems or waited

    def _hand_over(self, group: Group) -> None:
        """A file that comes in flight: whose is it?"""
        main = group.main
        if main.stem in self._stems:
            self._accompany(self._stems[main.stem], (main, *group.companions))
            return
        try:
            taken_s = self._source.taken_s(main)
        except CameraError:
            return  # the next look may find it again
        with self._lock:
            current = self._claims[0] if self._claims else None
        shown = None if taken_s is None else int(taken_s)
        verdict = attribute(self._late, current, shown, self._clock)
        if current is not None and verdict.shot == current.shot and shown is not None and not self._late:
            self._clock = self._clock.learnt(current, shown)
        facts = {"doubt": verdict.doubt} if verdict.doubt else {}
        if self._bring(verdict.shot, group, facts):
            self._late = [] if verdict.doubt else [one for one in self._late if one.shot != verdict.shot]

    def _match(self, fresh: list[Group]) -> None:
        """A card with all that was taken since: only pairs that are sure are taken now.

        Where nobody saw what lay on it before the flight, what is there may be of any day and any camera: then all
        shots must have found their files, and enough of them. The rest is left to `dappled flight pickup`.
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
        to_utc_ns = self._utc_ns() - self._clock_ns()
        shots = [matching.FiredShot(claim.shot, (claim.fired_ns + to_utc_ns) / 1e9) for claim in claims]
        by_name = {group.main.name: group for group in fresh}
        matched = matching.match(shots, dated)
        sure = self._old is not None or (not matched.shots and len(matched.pairs) >= _ENOUGH)
        brought = [self._bring(shot, by_name[name], {}) for shot, name in matched.pairs] if sure else []
        if all(brought):
            self._weighed = claims, fresh

    def _bring(self, shot: int | None, group: Group, facts: dict[str, str]) -> bool:
        try:
            blob = self._source.open(group.main)
        except CameraError:
            return False  # the next look may find it again
        assert self._done is not None
        self._done.add(group.main.name)
        self._first_seen.pop(group.main.stem, None)
        with self._lock:
            self._claims = [claim for claim in self._claims if claim.shot != shot]
        self._deliver(Arrival(shot, group.main.base, blob, self._clock_ns(), {"name": group.main.name, **facts}))
        if shot is not None:
            self._stems[group.main.stem] = shot
            self._accompany(shot, group.companions)
        return True

    def _accompany(self, shot: int, files: tuple[Found, ...]) -> None:
        assert self._done is not None
        for one in files:
            try:
                blob = self._source.open(one)
            except CameraError:
                continue
            self._done.add(one.name)
            self._deliver(Companion(shot, one.base, blob, self._clock_ns(), {"name": one.name}))

    def _bound(self) -> None:
        if not self._in_flight:
            return
        limit_ns = self._clock_ns() - round(self._file_s * 1e9)
        with self._lock:
            overdue = [claim for claim in self._claims if claim.fired_ns < limit_ns]
            self._claims = [claim for claim in self._claims if claim.fired_ns >= limit_ns]
        for claim in overdue:
            self._late = [*self._late, claim][-_LATE:]
            self._give_up(claim.shot, self._trouble)
