"""Write the ledger of a flight: what the pipeline records, and the interface behind which a replay compares it."""

from __future__ import annotations

import logging
from collections import deque
from typing import Protocol

from dappled import codec
from dappled.clock import Clock
from dappled.drivers.camera import Blob, Fired
from dappled.drivers.raw.recipe import DECISION, LawDecision
from dappled.errors import DappledError, report
from dappled.findings import Code, Finding, Subject, finding, named
from dappled.flight import Frame, Recording, Result, Shot, Tag

log = logging.getLogger(__name__)
_LATER = 1000
_RECENT = 10  # frames: another image format soon counts


class FlightWriter(Protocol):
    """Records what the pipeline produces, or, in a replay, compares it. Methods raise FlightError where they can't."""

    def requested(self, shot: Shot) -> None:
        """Enter a shot that stands in the journal. Called before its first event."""

    def frame(self, index: int) -> Frame | None:
        """A frame that is safe."""

    def tag(self, index: int) -> Tag | None:
        """The tag of a frame, once known."""

    def fired(self, event: Fired) -> None:
        """The trigger call was made."""

    def failed(self, index: int, why: Finding) -> None:
        """A shot will bring no frame."""

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe; when this returns it is."""

    def follows(self, index: int, why: Finding) -> None:
        """A shot was fired, and its file stays at the camera for now."""

    def companion(self, index: int, name: str, blob: Blob) -> None:
        """Make a file safe that stands beside a frame."""

    def path(self, frame: Frame) -> str:
        """Where the frame's file stands."""

    def tagged(self, tag: Tag) -> None:
        """A frame's tag is known."""

    def law_decided(self, decision: LawDecision) -> None:
        """A frame showed by which law this flight is decoded. Called before that frame's slices are."""

    def decoded(self, result: Result) -> None:
        """A frame's slices are known."""

    def event(self, kind: str, found: Finding, index: int | None = None) -> None:
        """Something happened."""


class LedgerWriter:
    """Writes one flight. Until its first event only the journal holds a shot: firing never waits for the ledger."""

    def __init__(self, recording: Recording, clock: Clock) -> None:
        self.recording, self._clock = recording, clock
        self._later: deque[tuple[str, Finding]] = deque(maxlen=_LATER)
        self._sizes: deque[int] = deque(maxlen=_RECENT)

    def requested(self, shot: Shot) -> None:
        """Enter a shot that stands in the journal."""
        self.recording.ledger.add_shot(shot)

    def frame(self, index: int) -> Frame | None:
        return self.recording.ledger.frame(index)

    def tag(self, index: int) -> Tag | None:
        return self.recording.ledger.tag(index)

    def fired(self, event: Fired) -> None:
        self.recording.ledger.fired(event.shot, event.called_monotonic_ns, event.returned_monotonic_ns)

    def failed(self, index: int, why: Finding) -> None:
        self.recording.ledger.failed(index, why)
        self._index(index)

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe. One that belongs to no shot is kept as a stray, and raises DappledError."""
        arrived_utc_ns = self._clock.utc_ns()
        recorder = self.recording.recorder
        if index is None:
            why = finding(Code.FILE_NO_SHOT, Subject("file", name))
            stray = recorder.record_stray(name, blob, why, arrived_utc_ns=arrived_utc_ns)
            raise DappledError(f"{named(why)} in {stray.name}")
        frame = recorder.record(index, name, blob, arrived_utc_ns=arrived_utc_ns)
        self._sizes.append(frame.size)
        self._index(index)
        return frame

    def follows(self, index: int, why: Finding) -> None:
        self.recording.ledger.follows(index, why)
        self._index(index)

    def companion(self, index: int, name: str, blob: Blob) -> None:
        recorder = self.recording.recorder
        recorder.record_companion(index, name, blob, arrived_utc_ns=self._clock.utc_ns())
        if self._sizes:
            self._sizes[-1] += blob.size

    @property
    def frame_bytes(self) -> float | None:
        """What the last frames took on disk each, with their companions, bytes; None before the first."""
        sizes = list(self._sizes)
        return sum(sizes) / len(sizes) if sizes else None

    def path(self, frame: Frame) -> str:
        return str(self.recording.folder.path / frame.name)

    def tagged(self, tag: Tag) -> None:
        self.recording.ledger.add_tag(tag)

    def law_decided(self, decision: LawDecision) -> None:
        """Write the law that a frame showed into flight.toml, so that replays and products decode as the flight did."""
        self.recording.add_facts({DECISION: codec.plain(decision)})
        self.event("law", decision.found, decision.first)

    def decoded(self, result: Result) -> None:
        self.recording.ledger.add_result(result)

    def event(self, kind: str, found: Finding, index: int | None = None) -> None:
        self.recording.ledger.add_event(kind, found, index)

    def later(self, kind: str, found: Finding) -> None:
        """Take an event from a thread that must not wait for the disk. `write_later` writes the last 1000."""
        self._later.append((kind, found))

    def write_later(self) -> None:
        """Write the events taken. Raises FlightError; the next call goes on from there."""
        while self._later:
            kind, found = self._later.popleft()
            try:
                self.event(kind, found)
            except DappledError:
                self._later.appendleft((kind, found))
                raise

    def _index(self, index: int) -> None:
        """Update the index over flights. It can be rebuilt from the ledgers, so a failure is only logged."""
        try:
            self.recording.note_image(index)
        except DappledError as error:
            report(log, "index", error)
