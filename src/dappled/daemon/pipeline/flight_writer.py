"""What the street writes: a flight's ledger, or, in a replay, a comparison with one."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from dappled.clock import Clock
from dappled.drivers.camera import Blob, Fired
from dappled.errors import DappledError, report
from dappled.flight import Frame, Recording, Result, Shot, ShotRow, Tag, digest, durable

log = logging.getLogger(__name__)
_LATER = 1000


class LedgerWriter:
    """Writes one flight. A wish's row is written with the first event of its shot: until then the shot journal holds
    it, so that firing never waits for the database."""

    def __init__(self, recording: Recording, clock: Clock) -> None:
        self._recording, self._clock = recording, clock
        self._lock = threading.Lock()
        self._requested: dict[int, Shot] = {}
        self._later: deque[tuple[str, str]] = deque(maxlen=_LATER)

    def requested(self, shot: Shot) -> None:
        """A shot is in the journal and on its way to the camera."""
        with self._lock:
            self._requested[shot.index] = shot

    def frame(self, index: int) -> Frame | None:
        """See FlightWriter."""
        return self._recording.ledger.frame(index)

    def tag(self, index: int) -> Tag | None:
        """See FlightWriter."""
        return self._recording.ledger.tag(index)

    def fired(self, event: Fired) -> None:
        """See FlightWriter."""
        self._enter(event.shot)
        self._recording.ledger.fired(event.shot, event.called_monotonic_ns, event.returned_monotonic_ns)

    def failed(self, index: int, reason: str) -> None:
        """See FlightWriter."""
        self._enter(index)
        self._recording.ledger.failed(index, reason)
        self._index(index)

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """See FlightWriter. A file that belongs to no shot is kept as a stray, and told as an error."""
        arrived_utc_ns = self._clock.utc_ns()
        recorder = self._recording.recorder
        if index is None:
            reason = f"{name} came without a shot: kept as a stray"
            stray = recorder.record_stray(name, blob, reason, arrived_utc_ns=arrived_utc_ns)
            raise DappledError(f"{reason} in {stray.name}")
        self._enter(index)
        frame = recorder.record(index, name, blob, arrived_utc_ns=arrived_utc_ns)
        self._index(index)
        return frame

    def follows(self, index: int, reason: str) -> None:
        """See FlightWriter."""
        self._enter(index)
        self._recording.ledger.follows(index, reason)
        self._index(index)

    def companion(self, index: int, name: str, blob: Blob) -> None:
        """See FlightWriter."""
        recorder = self._recording.recorder
        recorder.record_companion(index, name, blob, arrived_utc_ns=self._clock.utc_ns())

    def path(self, frame: Frame) -> str:
        """See FlightWriter."""
        return str(self._recording.folder.path / frame.name)

    def tagged(self, tag: Tag) -> None:
        """See FlightWriter."""
        self._recording.ledger.add_tag(tag)

    def decoded(self, result: Result) -> None:
        """See FlightWriter."""
        self._recording.ledger.add_result(result)

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        """See FlightWriter."""
        self._recording.ledger.add_event(kind, text, index)

    def later(self, kind: str, text: str) -> None:
        """An event from somebody who must not wait for the disk: `write_later` writes it. The last 1000 are kept."""
        self._later.append((kind, text))

    def write_later(self) -> None:
        """Write what waits. Raises FlightError; the next call goes on from there."""
        while self._later:
            kind, text = self._later.popleft()
            try:
                self.event(kind, text)
            except DappledError:
                self._later.appendleft((kind, text))
                raise

    def _enter(self, index: int) -> None:
        with self._lock:
            shot = self._requested.get(index)
        if shot is not None:
            self._recording.ledger.add_shot(shot)  # where it can't be entered now, the next event tries again
            with self._lock:
                self._requested.pop(index, None)

    def _index(self, index: int) -> None:
        """The index over flights is made from the ledgers: a shot is no worse for not standing there yet."""
        try:
            self._recording.note_image(index)
        except DappledError as error:
            report(log, "index", error)


@dataclass(frozen=True, slots=True)
class Expected:
    """What a recording says of one shot: the digests are None where it says nothing; `told` are its kinds of events."""

    row: ShotRow
    frame: Frame | None = None
    pose_sha256: str | None = None
    tag_sha256: str | None = None
    slices_sha256: str | None = None
    told: frozenset[str] = frozenset()

    @property
    def left_undecoded(self) -> bool:
        """Whether the flight says that it did not decode this frame: fallen behind, switched off, or nothing in it."""
        return self.slices_sha256 is None and "not decoded" in self.told


class ReplayVerifier:
    """Holds what comes down the street against what was recorded. `differences` are sentences.

    `keep`, where given, takes the results of another recipe, which are not compared; else nothing is written.
    """

    def __init__(
        self, root: Path, expected: Iterable[Expected], keep: Callable[[Result], object] | None = None
    ) -> None:
        self.root, self._keep = root, keep
        self._tags: dict[int, Tag] = {}
        self._expected = {one.row.shot.index: one for one in expected}
        self._seen: dict[int, set[str]] = {index: set() for index in self._expected}
        self.differences: list[str] = []

    def frame(self, index: int) -> Frame | None:
        """See FlightWriter."""
        one = self._expected.get(index)
        return None if one is None else one.frame

    def tag(self, index: int) -> Tag | None:
        """See FlightWriter."""
        return self._tags.get(index)

    def fired(self, event: Fired) -> None:
        """See FlightWriter."""

    def failed(self, index: int, reason: str) -> None:
        """See FlightWriter."""
        if self._expected[index].frame is not None:
            self.differences.append(f"frame {index}: {reason}")

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """See FlightWriter: the file is where it was; its bytes are hashed again."""
        frame = None if index is None else self._expected[index].frame
        if index is None or frame is None:
            raise DappledError(f"{name} belongs to no recorded frame")
        found = durable.hash_descriptor(blob.fd, blob.size)
        if (found, blob.size) != (frame.sha256, frame.size):
            self.differences.append(f"frame {index}: {frame.name} is not the file that was recorded")
        return frame

    def follows(self, index: int, reason: str) -> None:
        """See FlightWriter: the file has come by now, or it is replayed as failed."""

    def companion(self, index: int, name: str, blob: Blob) -> None:
        """See FlightWriter: a replay brings frames only."""

    def path(self, frame: Frame) -> str:
        """See FlightWriter."""
        return str(self.root / frame.name)

    def tagged(self, tag: Tag) -> None:
        """See FlightWriter."""
        one = self._expected[tag.index]
        self._tags[tag.index] = tag
        self._compare(tag.index, "pose", one.pose_sha256, digest(tag.pose))
        self._compare(tag.index, "tag", one.tag_sha256, digest(tag))

    def decoded(self, result: Result) -> None:
        """See FlightWriter."""
        if self._keep is not None:
            self._keep(result)
            self._seen[result.index].add("slices")
            return
        one = self._expected[result.index]
        if one.left_undecoded:
            self._seen[result.index].add("slices")  # there is nothing to compare them with, as the flight itself says
        else:
            self._compare(result.index, "slices", one.slices_sha256, result.slices_sha256)

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        """See FlightWriter. What was told of the shot in the flight too is no difference."""
        if index is not None and kind in self._expected[index].told:
            return
        self.differences.append(f"frame {index}: {kind}: {text}" if index is not None else f"{kind}: {text}")

    def verdict(self, *, decoded: bool = True) -> list[str]:
        """All differences, and what the replay did not come to compare. `decoded`: whether the flight was decoded as it
        flew; if not, only frames with recorded slices must have some again. Nor must those that it left undecoded."""
        missing = [
            f"frame {index}: its {what} did not come out of the replay"
            for index, one in self._expected.items()
            if one.frame is not None
            for what in ("pose", "tag", "slices")
            if what not in self._seen[index]
            and (what != "slices" or one.slices_sha256 or (decoded and not one.left_undecoded))
        ]
        return self.differences + missing

    def _compare(self, index: int, what: str, recorded: str | None, found: str) -> None:
        self._seen[index].add(what)
        if recorded is None:
            self.differences.append(f"frame {index}: the record holds no hash of its {what}")
        elif recorded != found:
            self.differences.append(f"frame {index}: its {what} came out different")
