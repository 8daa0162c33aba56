"""The shots under way: which story is whose, and how each one ends, once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from dappled.daemon.pipeline.pending_shot import FlightWriter, Observer, PendingShot
from dappled.errors import report
from dappled.flight import Frame, Shot

log = logging.getLogger(__name__)
GIVEN_UP = 16  # failed shots whose file is still known for theirs when it comes after all
FOLLOWING = 4096  # the same of shots whose file stays at the camera; with more, `geotag` makes the oldest one's tag


class PendingShots:
    """All stories in hand, from the wish on; any thread may ask and end them.

    A story leaves with `finish`, and its watchers hear of that once. One that failed, or whose file stays at the
    camera, is kept a while longer: its file may come after all.
    """

    def __init__(self, writer: FlightWriter, observer: Observer) -> None:
        self._writer, self._observer = writer, observer
        self._lock = threading.Lock()
        self._in_hand: dict[int, PendingShot] = {}
        self._given_up: dict[int, PendingShot] = {}
        self._following: dict[int, PendingShot] = {}

    # whose

    def expect(self, shot: Shot) -> None:
        """A shot was wished for and written down."""
        with self._lock:
            self._in_hand[shot.index] = PendingShot(shot)

    def in_hand(self, index: int) -> PendingShot | None:
        """The story of a shot that has not come to its end; None for any other."""
        return self._in_hand.get(index)

    def of_file(self, index: int) -> PendingShot | None:
        """The story that a file of this shot belongs to, also where it had ended without the file."""
        with self._lock:
            return self._in_hand.get(index) or self._given_up.get(index) or self._following.get(index)

    def waiting(self) -> list[int]:
        """The shots whose files are waited for."""
        with self._lock:
            return [index for index, pending in self._in_hand.items() if pending.open]

    # what becomes of a file

    def safe(self, pending: PendingShot, frame: Frame) -> PendingShot:
        """A shot's file is safe: the story that goes down the street with it. Of one that had ended without its file,
        or is about to, that is a second one, of whose end nobody is told again."""
        if pending.follows:
            pending = PendingShot(pending.shot, pending.fired, ms=pending.ms, over=True)
            with self._lock:
                self._in_hand[frame.index] = pending
        pending.frame = frame
        return pending

    def welcome(self, pending: PendingShot, index: int, name: str) -> None:
        """Note that a file came which had been given up, or was to follow."""
        with self._lock:
            followed, given_up = self._following.pop(index, None), self._given_up.pop(index, None)
        if followed:
            self.note("followed", f"its file has come: {name}", index)
        elif given_up:
            self.note("late", f"its file came after all; it had failed: {pending.problem}", index)
            pending.problem = ""
            with self._lock:
                self._in_hand[index] = pending

    def follow(self, pending: PendingShot, reason: str) -> None:
        """A shot's file stays at the camera for now."""
        pending.follows = reason
        with self._lock:
            self._following[pending.shot.index] = pending
            _forget_oldest(self._following, FOLLOWING)
        self.tell(self._observer.settled, pending.shot.index, False)

    # how a story ends

    def fail(self, pending: PendingShot, reason: str) -> None:
        """It ends without a frame, for now: see `GIVEN_UP`."""
        pending.problem = reason
        with self._lock:
            self._given_up[pending.shot.index] = pending
            _forget_oldest(self._given_up, GIVEN_UP)
        self.tell(self._observer.settled, pending.shot.index, False)
        self.tell(self._observer.tagged, pending)
        self.finish(pending)

    def leave(self, pending: PendingShot, what: str, why: str) -> None:
        """A safe frame goes no further down the street."""
        pending.problem = f"{what}: {why}"
        self.note(what, why, pending.shot.index)
        self.finish(pending)

    def finish(self, pending: PendingShot) -> None:
        """Nothing more is expected of it."""
        with self._lock:
            if self._in_hand.get(pending.shot.index) is pending:
                del self._in_hand[pending.shot.index]
            told, pending.over = pending.over, True
        if not told:
            self.tell(self._observer.finished, pending)

    # who hears of it

    def note(self, kind: str, text: str, index: int) -> None:
        """An event for the record, which goes on without it where the record refuses."""
        self.tell(self._writer.event, kind, text, index)

    def tell(self, told: Callable[..., Any], *facts: object) -> None:
        """Call somebody whose troubles are not the street's."""
        try:
            told(*facts)
        except Exception as error:  # noqa: BLE001  # whoever is told, the street goes on
            report(log, "street", error)


def _forget_oldest(shots: dict[int, PendingShot], most: int) -> None:
    while len(shots) > most:
        del shots[min(shots)]
