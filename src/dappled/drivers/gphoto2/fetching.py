"""Files on their way from the body: announced or found on its card, fetched, and told with the shot that made them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable

from dappled.drivers.attribution import Claim, attribute, true_name
from dappled.drivers.camera import Arrival, Companion
from dappled.drivers.gphoto2.messages import LATE
from dappled.drivers.gphoto2.pairs import makes_pairs
from dappled.drivers.gphoto2.protocol import (
    BusyError,
    CameraFile,
    CaptureComplete,
    FileAdded,
    RefusedError,
    Session,
)
from dappled.drivers.gphoto2.settings import Timeouts
from dappled.drivers.gphoto2.state import Books
from dappled.drivers.gphoto2.telling import Telling

_HEAD_BYTES = 65536
_TRIES = 3
_SETTINGS_NS = 1_000_000_000
"""So long after a file the settings are read: what it changed (battery, shots left) is known by then."""


class Fetching:
    """Brings files. `seen`: (folder, name) of those that an earlier process brought last."""

    def __init__(
        self,
        books: Books,
        telling: Telling,
        timeouts: Timeouts,
        seen: frozenset[tuple[str, str]],
        clock_ns: Callable[[], int],
    ) -> None:
        self._books, self._telling, self._timeouts = books, telling, timeouts
        self._seen, self._clock_ns = seen, clock_ns

    def find_new(self, session: Session) -> None:
        """Compare the card with what was on it: what came without a word is fetched now. Raises LostError."""
        books = self._books
        if not session.keeps_files:
            return
        found = session.files()
        if books.known is None:
            books.known = found - self._of_late_shots(session, found)
        queued = set(books.to_fetch)
        books.to_fetch.extend(sorted(found - books.known - queued, key=lambda file: (file.folder, file.name)))

    def listen(self, session: Session) -> None:
        """What the camera announced since the last time. Raises LostError."""
        books = self._books
        for news in session.news():
            match news:
                case FileAdded(file) if file not in books.to_fetch and file not in (books.known or ()):
                    books.to_fetch.append(file)
                case CaptureComplete() if books.flight and books.flight.fired_ns is not None:
                    books.flight.complete_ns = self._clock_ns()

    def fetch(self, session: Session) -> None:
        """Bring what waits, and what waited long enough for its pair. Raises LostError."""
        books = self._books
        while books.to_fetch:
            file = books.to_fetch[0]
            began_ns = self._clock_ns()
            try:
                fetched = session.fetch(file)
            except (BusyError, RefusedError) as error:
                books.to_fetch.popleft()
                self._again(file, str(error))
                break
            books.to_fetch.popleft()
            books.tries.pop(file, None)
            if books.known is not None and not file.in_memory:
                books.known |= {file}
            now_ns = self._clock_ns()
            facts = {"folder": file.folder, "name": file.name, "fetch_ms": (now_ns - began_ns) / 1e6}
            name = true_name(file.name, os.pread(fetched.blob.fd, _HEAD_BYTES, 0))
            arrival = Arrival(None, name, fetched.blob, now_ns, facts)
            books.settings_due_ns = now_ns + _SETTINGS_NS
            if makes_pairs(books.settings) and books.pairs.holds_back(file, arrival, fetched.taken_s):
                continue
            self._deliver(file, arrival, fetched.taken_s)
        for alone in books.pairs.overdue(self._clock_ns() - round(self._timeouts.complete_s * 1e9)):
            self._deliver(*alone)

    def _of_late_shots(self, session: Session, found: frozenset[CameraFile]) -> frozenset[CameraFile]:
        """Of a card that was never seen before: the files of shots that an earlier process fired, by the body's clock.

        They are among the last."""
        books = self._books
        if not books.late or not books.clock.offsets_s:
            return frozenset()
        unseen = (file for file in found if (file.folder, file.name) not in self._seen)
        last = sorted(unseen, key=lambda file: (file.folder, file.name))[-LATE:]
        times = {file: session.taken_s(file) for file in last}
        return frozenset(
            file
            for file, taken_s in times.items()
            if taken_s is not None and any(books.clock.fits(claim, taken_s) for claim in books.late)
        )

    def _again(self, file: CameraFile, reason: str) -> None:
        """A file was not to be had: later once more, or never."""
        books = self._books
        books.tries[file] = books.tries.get(file, 0) + 1
        if books.tries[file] < _TRIES and not file.in_memory:
            books.to_fetch.append(file)
            return
        del books.tries[file]
        if books.known is not None:
            books.known |= {file}
        if books.flight and books.flight.fired_ns is not None:
            stays = "" if file.in_memory else f"; it stays on the card as {file.folder}/{file.name}"
            self._telling.flight_failed(f"{reason}{stays}")

    def _deliver(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> None:
        """Say whose file it is, and close it: a frame, or the companion of the frame before."""
        try:
            main = self._books.pairs.main_of(file)
            if main is not None:
                companion = Companion(main, arrival.name, arrival.blob, arrival.monotonic_ns, arrival.facts)
                self._telling.tell(companion)
                return
            shot = self._deliver_frame(arrival, taken_s)
        finally:
            arrival.blob.close()
        for waiting in self._books.pairs.delivered(file, shot):
            self._deliver(*waiting)

    def _deliver_frame(self, arrival: Arrival, taken_s: int | None) -> int | None:
        books, flight = self._books, self._books.flight
        current = None if flight is None or flight.fired_ns is None else Claim(flight.shot, flight.fired_ns)
        verdict = attribute(books.late, current, taken_s, books.clock)
        if current is not None and verdict.shot == current.shot:
            books.flight = None
            if taken_s is not None and not books.late:
                books.clock = books.clock.learnt(current, taken_s)
        left = [] if verdict.doubt else [claim for claim in books.late if claim.shot != verdict.shot]
        books.late = deque(left, LATE)  # files come in order: after one in doubt none of the older is expected
        facts = {**arrival.facts, **({"doubt": verdict.doubt} if verdict.doubt else {})}
        facts["body_offsets_s"] = list(books.clock.offsets_s)
        self._telling.tell(Arrival(verdict.shot, arrival.name, arrival.blob, arrival.monotonic_ns, facts))
        return verdict.shot
