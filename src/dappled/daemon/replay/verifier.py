"""Compare what a replay produces with what was recorded."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dappled import durable
from dappled.drivers.camera import Blob, Fired
from dappled.drivers.raw.recipe import LawDecision
from dappled.errors import DappledError
from dappled.flight import Frame, Result, Shot, ShotRow, Tag, digest


@dataclass(frozen=True, slots=True)
class Expected:
    """What a recording says of one shot. Digests that it lacks are None; `events` are the kinds of its events."""

    row: ShotRow
    frame: Frame | None = None
    pose_sha256: str | None = None
    tag_sha256: str | None = None
    slices_sha256: str | None = None
    events: frozenset[str] = frozenset()

    @property
    def left_undecoded(self) -> bool:
        """Whether the flight says that it did not decode this frame: fallen behind, switched off, or nothing in it."""
        return self.slices_sha256 is None and "not decoded" in self.events


class ResultWriter(Protocol):
    """What takes results that are not compared: `RunWriter`."""

    def decoded(self, result: Result) -> None:
        """Take what came out of one frame."""


class ReplayVerifier:
    """Compares what the pipeline produces with what was recorded. `differences` are sentences.

    `keep`, where given, takes the results of another recipe, which are not compared; else nothing is written.
    """

    def __init__(self, root: Path, expected: Iterable[Expected], keep: ResultWriter | None = None) -> None:
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

    def requested(self, shot: Shot) -> None:
        """See FlightWriter: the shot is in the record."""

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

    def law_decided(self, decision: LawDecision) -> None:
        """See FlightWriter: a replay goes by what the flight decided."""

    def decoded(self, result: Result) -> None:
        """See FlightWriter."""
        if self._keep is not None:
            self._keep.decoded(result)
            self._seen[result.index].add("slices")
            return
        one = self._expected[result.index]
        if one.left_undecoded:
            self._seen[result.index].add("slices")  # there is nothing to compare them with, as the flight itself says
        else:
            self._compare(result.index, "slices", one.slices_sha256, result.slices_sha256)

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        """See FlightWriter. An event of a kind that the flight has for this shot too does not count as a difference."""
        if index is not None and kind in self._expected[index].events:
            return
        self.differences.append(f"frame {index}: {kind}: {text}" if index is not None else f"{kind}: {text}")

    def verdict(self, *, decoded: bool = True) -> list[str]:
        """All differences, and what the replay did not come to compare. `decoded`: whether the flight was decoded as it
        flew; if not, only frames with recorded slices must have some again. Nor must those that it left undecoded."""
        missing = [
            f"frame {index}: the replay made no {what}"
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
            self.differences.append(f"frame {index}: the {what} came out different")
