"""Compare what a replay produces with what was recorded."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from dappled import codec, durable
from dappled.decode.lightfield.light_field import difference
from dappled.drivers.camera import Blob, Fired
from dappled.drivers.raw.recipe import LawDecision
from dappled.errors import DappledError
from dappled.findings import Code, Evidence, Finding, Subject, finding
from dappled.flight import Frame, Result, Shot, ShotRow, Tag, digest

MOST_SHARE = 1e-6  # of a frame's largest value: what rounding on another platform does to slices, with room


@dataclass(frozen=True, slots=True)
class Expected:
    """What a recording says of one shot. Digests that it lacks are None; `events` are the kinds of its events,
    `undecoded` whether one says that it was not decoded.

    `tag` (with its pose) and `fingerprint` (of the slices) are compared where the last bits can't be the same."""

    row: ShotRow
    frame: Frame | None = None
    pose_sha256: str | None = None
    tag_sha256: str | None = None
    slices_sha256: str | None = None
    tag: Tag | None = None
    fingerprint: Mapping[str, Any] | None = None
    events: frozenset[str] = frozenset()
    undecoded: bool = False

    @property
    def left_undecoded(self) -> bool:
        """Whether the flight says that it did not decode this frame: fallen behind, switched off, or nothing in it."""
        return self.slices_sha256 is None and self.undecoded


class ResultWriter(Protocol):
    """What takes results that are not compared: `RunWriter`."""

    def decoded(self, result: Result) -> None:
        """Take what came out of one frame."""


class ReplayVerifier:
    """Compares what the pipeline produces with what was recorded.

    `keep`, where given, takes the results of another recipe, which are not compared; else nothing is written.
    `elsewhere` says where the flight was recorded, if that is another platform or other versions: numbers are then
    compared where hashes differ. `close` counts what was equal in this sense, `furthest` is the largest difference of
    slices among them and its frame.
    """

    def __init__(
        self,
        root: Path,
        expected: Iterable[Expected],
        keep: ResultWriter | None = None,
        *,
        elsewhere: str | None = None,
    ) -> None:
        self.root, self._keep, self.elsewhere = root, keep, elsewhere
        self.close = 0
        self.furthest: tuple[float, int] = (0.0, -1)
        self._tags: dict[int, Tag] = {}
        self._expected = {one.row.shot.index: one for one in expected}
        self._seen: dict[int, set[str]] = {index: set() for index in self._expected}
        self._differences: list[Finding] = []

    def frame(self, index: int) -> Frame | None:
        one = self._expected.get(index)
        return None if one is None else one.frame

    def tag(self, index: int) -> Tag | None:
        return self._tags.get(index)

    def requested(self, shot: Shot) -> None:
        """Enter a shot that stands in the journal. The shot is in the record."""

    def fired(self, event: Fired) -> None:
        """The trigger call was made."""

    def failed(self, index: int, why: Finding) -> None:
        if self._expected[index].frame is not None:
            self._differences.append(replace(why, subject=Subject("frame", index)))

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe; when this returns it is. The file is where it was; its bytes are hashed again."""
        frame = None if index is None else self._expected[index].frame
        if index is None or frame is None:
            raise DappledError(f"{name} belongs to no recorded frame")
        found = durable.hash_descriptor(blob.fd, blob.size)
        if (found, blob.size) != (frame.sha256, frame.size):
            self._differ(Code.REPLAY_OTHER_FILE, index, file=frame.name)
        return frame

    def follows(self, index: int, why: Finding) -> None:
        """A shot's file stays at the camera: it has come by now, or the shot is replayed as failed."""

    def companion(self, index: int, name: str, blob: Blob) -> None:
        """Make a file safe that stands beside a frame. A replay brings frames only."""

    def path(self, frame: Frame) -> str:
        return str(self.root / frame.name)

    def tagged(self, tag: Tag) -> None:
        one = self._expected[tag.index]
        self._tags[tag.index] = tag
        recorded = codec.plain(one.tag)
        found = codec.plain(tag)
        near = recorded is not None and _near(recorded["pose"], found["pose"])
        self._compare(tag.index, "pose", (one.pose_sha256, digest(tag.pose)), near=near)
        near = recorded is not None and _near(recorded, found)
        self._compare(tag.index, "tag", (one.tag_sha256, digest(tag)), near=near)

    def law_decided(self, decision: LawDecision) -> None:
        """A frame showed by which law this flight is decoded. A replay goes by what the flight decided."""

    def decoded(self, result: Result) -> None:
        if self._keep is not None:
            self._keep.decoded(result)
            self._seen[result.index].add("slices")
            return
        one = self._expected[result.index]
        if one.left_undecoded:
            self._seen[result.index].add("slices")  # there is nothing to compare them with, as the flight itself says
        else:
            hashes = one.slices_sha256, result.slices_sha256
            self._compare(result.index, "slices", hashes, share=self._share(one, result))

    def event(self, kind: str, found: Finding, index: int | None = None) -> None:
        """Something happened. An event of a kind that the flight has for this shot too is no difference."""
        if index is not None and kind in self._expected[index].events:
            return
        self._differ(Code.REPLAY_OTHER_EVENT, "" if index is None else index, kind=kind, text=found)

    def verdict(self, *, decoded: bool = True) -> list[Finding]:
        """All differences, and what the replay did not come to compare. `decoded`: whether the flight was decoded as it
        flew; if not, only frames with recorded slices must have some again. Nor must those that it left undecoded."""
        missing = [
            finding(Code.REPLAY_NOT_MADE, Subject("frame", index), what=what)
            for index, one in self._expected.items()
            if one.frame is not None
            for what in ("pose", "tag", "slices")
            if what not in self._seen[index]
            and (what != "slices" or one.slices_sha256 or (decoded and not one.left_undecoded))
        ]
        return self._differences + missing

    def _share(self, one: Expected, result: Result) -> float | None:
        """How far the slices are from the recorded ones, as a share of the largest value; None where that is not
        known."""
        found = result.details.get("fingerprint")
        return None if one.fingerprint is None or found is None else difference(one.fingerprint, found)

    def _compare(
        self, index: int, what: str, hashes: tuple[str | None, str], *, near: bool = False, share: float | None = None
    ) -> None:
        """Compare (recorded, found) hashes; on another platform `near`, or the `share` by which numbers differ."""
        self._seen[index].add(what)
        recorded, found = hashes
        if recorded is None:
            self._differ(Code.REPLAY_NO_HASH, index, what=what)
        elif recorded == found:
            return
        elif self.elsewhere is None:
            self._differ(Code.REPLAY_DIFFERENT, index, what=what)
        elif near or (share is not None and share <= MOST_SHARE):
            self.close += 1
            self.furthest = max(self.furthest, (share or 0.0, index))
        elif what != "slices":
            self._differ(Code.REPLAY_NUMBERS_DIFFER, index, what=what)
        elif share is None:
            self._differ(Code.REPLAY_NUMBERS_LACKING, index, elsewhere=self.elsewhere)
        elif share < math.inf:
            self._differ(Code.REPLAY_SLICES_DIFFER, index, share=share, elsewhere=self.elsewhere)
        else:
            self._differ(Code.REPLAY_OTHER_SHAPE, index, elsewhere=self.elsewhere)

    def _differ(self, code: Code, index: int | str, **facts: Evidence) -> None:
        self._differences.append(finding(code, Subject("frame", index)).with_facts(**facts))


def _near(recorded: Any, found: Any) -> bool:
    """Whether two records, as JSON values, differ by rounding alone: real numbers by 1e-9 of themselves or of 1, whole
    nanoseconds and microseconds by 1."""
    if isinstance(recorded, Mapping) and isinstance(found, Mapping):
        return recorded.keys() == found.keys() and all(
            _near(value, found[key])
            if not (key.endswith(("_ns", "_us")) and isinstance(value, int) and isinstance(found[key], int))
            else abs(value - found[key]) <= 1
            for key, value in recorded.items()
        )
    if isinstance(recorded, list | tuple) and isinstance(found, list | tuple):
        return len(recorded) == len(found) and all(map(_near, recorded, found))
    if isinstance(recorded, float) and isinstance(found, float):
        return abs(recorded - found) <= 1e-9 * max(1.0, abs(recorded))
    return bool(recorded == found)
