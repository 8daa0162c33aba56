"""Know a card's files by name, size, time and bytes, and by the numbers that a camera counts in their names.

A card that was changed may number from 0001 again: a known name is not a known file. libgphoto2 gives no number of a
file that would last longer than a session, and no time of one that is made within 2 s of a listing: that one is fetched
again where a file of its name and size has a time later, or is announced, and its bytes tell.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from dappled.drivers.gphoto2.messages import SeenFile
from dappled.drivers.gphoto2.protocol import CameraFile, CardContents, FileFacts

_NEIGHBOURS = 64
"""Camera counters run from 1 to 9999 and begin again. Names that are farther apart say nothing of their order."""
_COUNTER = re.compile(r"(.*?)(\d{4})")
_ZONE_S, _ZONES = 900, 56
"""A body's time may be shown in the zone of a computer, or not: whole quarters of an hour, at most 14 hours."""

Counter = tuple[str, int]


@dataclass(frozen=True, slots=True)
class _Brought:
    """A file that was fetched, and its hash; None: unknown, of one that an earlier process brought to memory."""

    facts: FileFacts
    sha256: str | None


@dataclass(frozen=True, slots=True)
class _Frame:
    """A file whose shot is certain."""

    counter: Counter
    shot: int
    taken_s: int | None


class KnownCard:
    """The files on the card that is in the camera, and those that were brought from any card."""

    def __init__(self, brought: Iterable[SeenFile]) -> None:
        self.is_listed = False
        self._label = ""
        self._files: dict[CameraFile, FileFacts | None] = {}  # None: it couldn't be brought, whatever it is
        self._brought: dict[CameraFile, list[_Brought]] = {}
        self._newest: Counter | None = None
        for folder, name, size, taken_s, sha256 in brought:
            file = CameraFile(folder, name)
            self.settle(file, (size, taken_s), sha256)
            self._newest = _counter(file)
        self._frames: deque[_Frame] = deque(maxlen=_NEIGHBOURS)

    # --- files

    def has_name(self, file: CameraFile) -> bool:
        """Whether a file of this name is known on the card."""
        return file in self._files

    def has(self, file: CameraFile, facts: FileFacts) -> bool:
        """Whether this very file needs no fetching: it is known on the card, or was brought from any. One that was
        brought without a time, and has one now, may be another: its bytes tell."""
        if file in self._files and self._files[file] is None:
            return True
        known = [one for one in self._facts(file) if _same(one, facts)]
        return any(one[1] is not None or facts[1] is None for one in known)

    def is_proven(self, file: CameraFile, facts: FileFacts) -> bool:
        """Whether a known name is this very file for certain: its time is known, too. libgphoto2 may have none of a
        file that was made within 2 s of a listing; another of this size can't be told from it then."""
        if file in self._files and self._files[file] is None:
            return True
        known = [one for one in self._facts(file) if _same(one, facts)]
        return any(one[1] is not None and facts[1] is not None for one in known)

    def is_again(self, file: CameraFile, facts: FileFacts, sha256: str) -> bool | None:
        """Whether a file that was fetched is one that had been fetched before, by its bytes; None where no other of
        this name, size and (where both are known) time was."""
        alike = [one.sha256 for one in self._brought.get(file, ()) if one.sha256 and _same(one.facts, facts)]
        return sha256 in alike if alike else None

    def _facts(self, file: CameraFile) -> list[FileFacts]:
        """What is known of files of this name, on this card and brought from any."""
        there = self._files.get(file)
        return [*([] if there is None else [there]), *(one.facts for one in self._brought.get(file, ()))]

    def is_done(self, file: CameraFile) -> bool:
        """Whether a known file was brought or given up: it isn't one that was there before."""
        return file in self._files and (self._files[file] is None or file in self._brought)

    def is_other(self, found: CardContents, *, has_old: bool) -> bool:
        """Whether this is another card than the one that is known: it says so, has another file of a known name, or
        nothing that is known, and a file was or is there (`has_old`: one from before the last listing). One that was
        erased can't be told from another."""
        if self._label and found.card and self._label != found.card:
            return True
        there = [(known, found.files[file]) for file, known in self._files.items() if file in found.files]
        if any(known is not None and not _same(known, facts) for known, facts in there):
            return True
        return not there and (bool(self._files) or has_old)

    def change(self) -> None:
        """Another card is in the camera."""
        self._files = {}
        self.count_anew()

    def count_anew(self) -> None:
        """What the camera counted so far says nothing of what comes."""
        self._newest = None
        self._frames.clear()

    def list(self, found: CardContents, coming: Iterable[CameraFile]) -> None:
        """The card was listed; the files that are `coming` are not known yet."""
        coming = frozenset(coming)
        given_up = {file for file, facts in self._files.items() if facts is None}
        self._files = {
            file: None if file in given_up else facts for file, facts in found.files.items() if file not in coming
        }
        self._label, self.is_listed = found.card or self._label, True
        if self._newest is None and self._files:
            newest = max(self._files, key=lambda file: (found.files[file][1] or 0, file.folder, file.name))
            self._newest = _counter(newest)

    def settle(self, file: CameraFile, facts: FileFacts | None, sha256: str | None = None) -> None:
        """A file was brought, or (None) given up."""
        self._files[file] = facts
        if facts is not None:
            self._brought.setdefault(file, []).append(_Brought(facts, sha256))

    def deleted(self, file: CameraFile) -> None:
        """A file was deleted: the camera may use its name again."""
        self._files.pop(file, None)
        self._brought.pop(file, None)

    # --- what the camera counts

    def count(self, file: CameraFile) -> bool:
        """Take in the name of a new file. Returns whether a picture may have been missed before it."""
        counter, before = _counter(file), self._newest
        if counter is None:
            return False
        steps = 2 if before is None else _steps(before, counter)
        if before is None or steps is None or steps > 0:
            self._newest = counter
        return steps is not None and steps > 1

    def is_newer(self, file: CameraFile) -> bool:
        """Whether a file was made after the newest that is known, by its name."""
        counter = _counter(file)
        return counter is not None and self._newest is not None and (_steps(self._newest, counter) or 0) > 0

    def made(self, file: CameraFile, shot: int, taken_s: int | None) -> None:
        """A shot made this file for certain."""
        if counter := _counter(file):
            self._frames.append(_Frame(counter, shot, taken_s))

    def neighbours(self, file: CameraFile, taken_s: int | None) -> tuple[int | None, int | None]:
        """The shots whose files are next before and behind this one by their names. None where there are none, and
        where times contradict: the camera has begun to count anew, or its clock was set."""
        counter = _counter(file)
        near = [(one, steps) for one in self._frames if counter and (steps := _steps(one.counter, counter))]
        for one, steps in near:
            if taken_s is not None and one.taken_s is not None and (taken_s - one.taken_s) * steps < 0:
                return None, None
        before = max((one.shot for one, steps in near if steps > 0), default=None)
        return before, min((one.shot for one, steps in near if steps < 0), default=None)


def _counter(file: CameraFile) -> Counter | None:
    """What the camera counts in a file's name, with what stands before; None where it doesn't count."""
    found = None if file.in_memory else _COUNTER.fullmatch(file.name.rpartition(".")[0])
    return None if found is None else (found[1], int(found[2]))


def _steps(before: Counter, after: Counter) -> int | None:
    """How many pictures from one counter to another; None where they are not of one row, or too far apart."""
    steps = (after[1] - before[1] + 4999) % 9999 - 4999
    return steps if before[0] == after[0] and abs(steps) < _NEIGHBOURS else None


def _same(one: FileFacts, other: FileFacts) -> bool:
    """Whether two files of one name may be one, by size and, where both are known, time."""
    apart_s = 0 if one[1] is None or other[1] is None else abs(one[1] - other[1])
    return one[0] == other[0] and apart_s % _ZONE_S == 0 and apart_s <= _ZONES * _ZONE_S
