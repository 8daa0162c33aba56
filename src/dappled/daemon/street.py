"""The one-way street: camera events → record → tag → decode → publish, the same for a live flight and a replay.

Each crossing is a bounded queue (see `stages`). What differs between a flight and a replay is handed in: the camera,
the book that is written or compared, where poses come from.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from dappled.daemon import tagger, wire
from dappled.daemon.development import Developed, Developer
from dappled.daemon.publisher import Publisher
from dappled.daemon.stages import Stage
from dappled.daemon.tagger import BodyLatency
from dappled.drivers import rawfile
from dappled.drivers.camera import Arrival, Blob, Camera, Fired, Identity, ShotFailed, State, StateChanged
from dappled.drivers.darkroom import camera_name
from dappled.errors import DappledError
from dappled.flight.entries import Result
from dappled.flight.records import Frame, Pose, Shot, Tag

log = logging.getLogger(__name__)


class Book(Protocol):
    """What the street writes down, or, in a replay, compares. Raises FlightError where it can't."""

    def frame(self, index: int) -> Frame | None:
        """A frame that is safe."""

    def tag(self, index: int) -> Tag | None:
        """The tag of a frame, once known."""

    def fired(self, event: Fired) -> None:
        """The trigger call was made."""

    def failed(self, index: int, reason: str) -> None:
        """A shot will bring no frame."""

    def record(self, index: int | None, name: str, blob: Blob) -> Frame:
        """Make a file safe; when this returns it is."""

    def path(self, frame: Frame) -> str:
        """Where the frame's file stands."""

    def tagged(self, tag: Tag) -> None:
        """A frame's tag is known."""

    def decoded(self, result: Result) -> None:
        """A frame's slices are known."""

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        """Something happened."""


PoseSource = Callable[[int, int, int], Pose]  # (image index, mid-exposure utc_ns, its sigma_ns) → pose; waits, bounded


@dataclass(slots=True)
class Story:
    """One shot on its way down the street, for those who watch: filled in as it goes. Times in milliseconds."""

    shot: Shot
    fired: Fired | None = None
    frame: Frame | None = None
    tag: Tag | None = None
    developed: Developed | None = None
    problem: str = ""
    ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Watchers:
    """Who is told what: `settled` when a shot is safe (True) or failed, `tagged` when its tag is known, `finished`
    when nothing more will happen to it, `camera` at every change of the camera's state."""

    settled: Callable[[int, bool], None] = lambda index, ok: None
    tagged: Callable[[Story], None] = lambda story: None
    finished: Callable[[Story], None] = lambda story: None
    camera: Callable[[StateChanged], None] = lambda change: None


@dataclass(frozen=True, slots=True)
class Names:
    """What headers and tags call things. `camera` "auto" takes the model that the frame names."""

    camera: str
    mask: str
    law: str


class Street:
    """Runs the stages. `developer` None: frames are recorded and tagged, and decoded later."""

    def __init__(
        self,
        *,
        camera: Camera,
        book: Book,
        poses: PoseSource,
        developer: Developer | None,
        publisher: Publisher | None,
        latency: BodyLatency,
        names: Names,
        watchers: Watchers,
        decode_queue: int,
        preview_interval_s: float = 0.0,
    ) -> None:
        self._camera, self._book, self._poses, self._developer = camera, book, poses, developer
        self._publisher, self._latency, self._names, self._watchers = publisher, latency, names, watchers
        self._preview_interval_s, self._last_preview = preview_interval_s, -1e9
        self._stories: dict[int, Story] = {}
        self.camera_state: State = "starting"
        self.camera_reason = ""
        self.identity: Identity | None = None
        self._stopping, self._give_up_at = threading.Event(), 0.0
        self._capture = threading.Thread(target=self._pull_events, name="capture", daemon=True)
        self._tag: Stage[Story] = Stage(
            "tag", self._tag_one, capacity=1000, on_failure=self._give_up("not tagged"), on_drop=self._dropped
        )
        self._decode: Stage[Story] = Stage(
            "decode", self._decode_one, capacity=decode_queue, on_failure=self._give_up("not decoded"),
            on_drop=self._dropped,
        )  # fmt: skip
        self.stages = (self._tag, self._decode)

    def start(self) -> None:
        """Begin: the camera first."""
        for stage in self.stages:
            stage.start()
        self._camera.start()
        self._capture.start()

    def expect(self, shot: Shot) -> None:
        """A shot was wished for and is handed to the camera now."""
        self._stories[shot.index] = Story(shot)

    def stop(self, timeout_s: float) -> None:
        """Finish what is in hand, at most `timeout_s`; let go of the camera. What is left stays in the record."""
        until = time.monotonic() + timeout_s
        self._give_up_at = until
        self._stopping.set()
        if self._capture.is_alive():
            self._capture.join(timeout_s + 1)
        self._camera.stop()
        for stage in self.stages:
            stage.stop(max(0.1, until - time.monotonic()))

    # capture: the camera's events, in order

    def _pull_events(self) -> None:
        while not self._stopping.is_set() or self._in_hand():
            event = self._camera.next_event(0.1)
            try:
                if isinstance(event, StateChanged):
                    self._state_changed(event)
                elif isinstance(event, Fired):
                    self._fired(event)
                elif isinstance(event, ShotFailed):
                    self._shot_failed(event.shot, event.reason)
                elif isinstance(event, Arrival):
                    self._arrived(event)
            except DappledError as error:
                log.warning("%s", error)

    def _in_hand(self) -> bool:
        """Whether a shot is with the camera, and still worth waiting for."""
        waiting = any(story.frame is None for story in list(self._stories.values()))
        return waiting and time.monotonic() < self._give_up_at

    def _state_changed(self, change: StateChanged) -> None:
        self.camera_state, self.camera_reason = change.state, change.reason
        self.identity = change.identity or self.identity
        self._watchers.camera(change)

    def _fired(self, event: Fired) -> None:
        if story := self._stories.get(event.shot):
            story.fired = event
            story.ms["wish to trigger"] = (event.called_monotonic_ns - story.shot.wished_monotonic_ns) / 1e6
            story.ms["trigger call"] = (event.returned_monotonic_ns - event.called_monotonic_ns) / 1e6
        self._book.fired(event)

    def _shot_failed(self, index: int, reason: str) -> None:
        story = self._stories.pop(index, None)
        try:
            self._book.failed(index, reason)
        finally:
            self._watchers.settled(index, False)
            if story:
                story.problem = reason
                self._watchers.tagged(story)
                self._watchers.finished(story)

    def _arrived(self, arrival: Arrival) -> None:
        began = time.monotonic_ns()
        try:
            frame = self._book.record(arrival.shot, arrival.name, arrival.blob)
        except DappledError as error:
            if arrival.shot is not None and arrival.shot in self._stories:
                self._lost(arrival.shot, str(error))
            raise
        finally:
            arrival.blob.close()
        self._camera.release(arrival)
        if arrival.shot is None or (story := self._stories.get(arrival.shot)) is None:
            return
        story.frame = frame
        if story.fired:
            story.ms["trigger to file"] = (arrival.monotonic_ns - story.fired.returned_monotonic_ns) / 1e6
        story.ms["record"] = (time.monotonic_ns() - began) / 1e6
        self._watchers.settled(arrival.shot, True)
        self._tag.put(story)

    def _lost(self, index: int, reason: str) -> None:
        """The recorder could not make a frame safe, and has noted that as far as the disk lets it."""
        story = self._stories.pop(index)
        story.problem = reason
        self._watchers.settled(index, False)
        self._watchers.tagged(story)
        self._watchers.finished(story)

    # tag

    def _tag_one(self, story: Story) -> None:
        began = time.monotonic_ns()
        frame = story.frame
        assert frame is not None
        settings = self._settings(frame)
        fired_utc_ns = self._fired_utc_ns(story, frame)
        exposure = tagger.mid_exposure(fired_utc_ns, self._latency, settings.exposure_s)
        pose = self._poses(frame.index, exposure.utc_ns, exposure.sigma_ns)
        camera = camera_name(self._names.camera, settings.model)
        story.tag = tagger.tag(frame, exposure, settings, camera=camera, mask=self._names.mask, pose=pose)
        self._book.tagged(story.tag)
        story.ms["tag"] = (time.monotonic_ns() - began) / 1e6
        self._watchers.tagged(story)
        if self._publisher:
            self._publisher.publish("frame", frame_header(story.tag, frame, self._names.law or None))
        if self._developer is None:
            self._finish(story)
        else:
            self._decode.put(story)

    def _settings(self, frame: Frame) -> tagger.Settings:
        try:
            facts = rawfile.read_metadata(self._book.path(frame))
        except DappledError as error:
            self._book.event("unreadable", str(error), frame.index)
            return tagger.Settings()
        return tagger.Settings(facts.focal_length_mm, facts.f_number, facts.exposure_s, facts.iso, facts.model or "")

    def _fired_utc_ns(self, story: Story, frame: Frame) -> int:
        """The trigger call in UTC; the wish, where the driver never said when it fired."""
        offset = story.shot.wished_utc_ns - story.shot.wished_monotonic_ns
        if story.fired is None:
            self._book.event("untimed", "the driver never said when it fired: the wish's time is used", frame.index)
            return story.shot.wished_utc_ns
        return story.fired.called_monotonic_ns + offset

    # decode and publish

    def _decode_one(self, story: Story) -> None:
        frame, tag = story.frame, story.tag
        assert frame is not None
        assert tag is not None
        assert self._developer is not None
        began = time.monotonic_ns()
        developed = self._developer.develop(self._book.path(frame), tag.focal_length_mm, tag.f_number)
        story.developed = developed
        self._book.decoded(developed.result(frame.index, (time.monotonic_ns() - began) / 1e6))
        story.ms["decode"] = (time.monotonic_ns() - began) / 1e6
        began = time.monotonic_ns()
        self._publish(tag, developed)
        story.ms["publish"] = (time.monotonic_ns() - began) / 1e6
        self._finish(story)

    def _publish(self, tag: Tag, developed: Developed) -> None:
        if self._publisher is None:
            return
        self._publisher.publish("slices", slices_header(tag, developed), developed.body)
        now = time.monotonic()
        if developed.preview and now - self._last_preview >= self._preview_interval_s:
            self._last_preview = now
            facts = wire.frame_facts(tag, developed.law)
            size = {"width": developed.preview_size[0], "height": developed.preview_size[1]}
            self._publisher.publish("preview", {**facts, "media_type": "image/jpeg", **size}, developed.preview)

    def _give_up(self, what: str) -> Callable[[Story, Exception], None]:
        def tell(story: Story, error: Exception) -> None:
            text = str(error) if isinstance(error, DappledError) else f"{type(error).__name__}: {error}"
            story.problem = f"{what}: {text}"
            self._book.event(what, text, story.shot.index)
            self._finish(story)

        return tell

    def _dropped(self, story: Story) -> None:
        story.problem = "not decoded: the queue was full, or the flight ended; the frame is in the record"
        self._book.event("not decoded", "the queue was full; decode it later", story.shot.index)
        self._finish(story)

    def _finish(self, story: Story) -> None:
        self._stories.pop(story.shot.index, None)
        self._watchers.finished(story)


def slices_header(tag: Tag, developed: Developed) -> dict[str, object]:
    """The facts of a `slices` message, live or asked for."""
    return {
        **wire.frame_facts(tag, developed.law),
        "carriers": developed.carriers,
        "carriers_from": developed.carriers_from,
        "carriers_found": developed.carriers_found,
        "grid": developed.grid,
        "slices_sha256": developed.sha256,
        "arrays": developed.arrays,
    }


def frame_header(tag: Tag, frame: Frame, law: str | None) -> dict[str, object]:
    """The facts of a `frame` message, live or asked for."""
    return {
        **wire.frame_facts(tag, law),
        "utc_sigma_ns": tag.utc_sigma_ns,
        "time_source": tag.time_source,
        "exposure_s": tag.exposure_s,
        "iso": tag.iso,
        "name": frame.name,
        "size": frame.size,
    }
