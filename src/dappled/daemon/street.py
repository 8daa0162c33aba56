"""The one-way street: camera events → record → tag → decode → publish, the same for a live flight and a replay.

Each crossing is a bounded queue (see `stages`). What differs between a flight and a replay is handed in: the camera,
the book that is written or compared, where poses come from.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from dappled.daemon import camera_clock, tagger, wire
from dappled.daemon.camera_clock import CameraClock
from dappled.daemon.development import Developed, Developer
from dappled.daemon.headers import frame_header, slices_header
from dappled.daemon.publisher import Publisher
from dappled.daemon.stages import Stage
from dappled.daemon.story import Book, Names, PoseSource, Story, Watchers
from dappled.daemon.tagger import BodyLatency, Exposure
from dappled.drivers import rawfile
from dappled.drivers.camera import (
    Arrival,
    Camera,
    Companion,
    Deferred,
    Event,
    Fired,
    Identity,
    SettingsChanged,
    ShotFailed,
    State,
    StateChanged,
)
from dappled.drivers.darkroom import camera_name
from dappled.errors import DappledError, report, sentence
from dappled.flight.records import Frame, Shot, Tag

log = logging.getLogger(__name__)
GIVEN_UP = 16  # failed shots whose file is still known for theirs when it comes after all


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
        self._given_up: dict[int, Story] = {}
        self._following: dict[int, Story] = {}
        self._zoom: tuple[int, float] | None = None  # the tag thread's: frame, focal length
        self._unfired: deque[ShotFailed] = deque()
        self._camera_clock = CameraClock()  # the tag thread's
        self.decoding = True  # off: frames are recorded and tagged, and decoded on the ground
        self.camera_state: State = "starting"
        self.camera_reason = ""
        self.identity: Identity | None = None
        self._stopping, self._give_up_at = threading.Event(), 0.0
        self._capture = threading.Thread(target=self._pull_events, name="capture", daemon=True)
        self._tag: Stage[Story] = Stage(
            "tag", self._tag_one, capacity=1000, on_failure=self._untagged, on_drop=self._drop("not tagged")
        )
        self._decode: Stage[Story] = Stage(
            "decode",
            self._decode_one,
            capacity=decode_queue,
            on_failure=self._undecoded,
            on_drop=self._drop("not decoded"),
        )
        self.stages = (self._tag, self._decode)

    def start(self) -> None:
        """Begin: the camera first."""
        for stage in self.stages:
            stage.start()
        self._camera.start()
        self._capture.start()

    def expect(self, shot: Shot) -> None:
        """A shot was wished for and written down; `fire` follows."""
        self._stories[shot.index] = Story(shot)

    def fire(self, index: int) -> None:
        """Hand an expected shot to the camera. Never raises: a shot that the driver won't take has failed."""
        try:
            self._camera.fire(index)
        except Exception as error:  # noqa: BLE001  # any driver's; the shot is written down already and must come to an end
            reason = f"the camera driver did not take the shot: {sentence(error)}"
            self._unfired.append(ShotFailed(index, reason, time.monotonic_ns()))

    def dead(self) -> list[str]:
        """Which of the street's threads have ended without being asked to: none, unless there is a bug."""
        if self._stopping.is_set():
            return []
        threads = [("capture", self._capture.is_alive()), *((stage.name, stage.alive) for stage in self.stages)]
        return [name for name, alive in threads if not alive]

    def decoding_idle(self, timeout_s: float = 5.0) -> bool:
        """Whether no frame waits to be decoded, at the latest after `timeout_s`."""
        return self._decode.wait_idle(timeout_s)

    def in_hand(self, index: int) -> bool:
        """Whether a shot is still on its way down the street, and not tagged yet."""
        story = self._stories.get(index)
        return story is not None and story.tag is None

    def stop(self, timeout_s: float) -> None:
        """Finish what is in hand, at most `timeout_s`; let go of the camera. What is left stays in the record, and a
        shot without a file has failed."""
        until = time.monotonic() + timeout_s
        self._give_up_at = until
        self._stopping.set()
        if self._capture.is_alive():
            self._capture.join(timeout_s + 1)
        self._call(self._camera.stop)
        if not self._capture.is_alive():
            self._last_events()
        for stage in self.stages:
            stage.stop(max(1.0, until - time.monotonic()))

    # capture: the camera's events, in order

    def _pull_events(self) -> None:
        while not self._stopping.is_set() or self._in_hand():
            self._handle(self._next_event(0.1))

    def _last_events(self) -> None:
        """What came while the camera was let go of; then every shot that is still open has failed."""
        until = time.monotonic() + 1
        while (event := self._next_event(0.0)) is not None and time.monotonic() < until:
            self._handle(event)
        for index in [story.shot.index for story in list(self._stories.values()) if story.open]:
            self._handle(ShotFailed(index, "the flight ended before its file came", time.monotonic_ns()))

    def _next_event(self, timeout_s: float) -> Event | None:
        if self._unfired:
            return self._unfired.popleft()
        try:
            return self._camera.next_event(timeout_s)
        except Exception as error:  # noqa: BLE001  # any driver's; the capture goes on, at a pace that leaves others their time
            report(log, "the camera driver", error)
            time.sleep(timeout_s)
            return None

    def _handle(self, event: Event | None) -> None:
        try:
            if isinstance(event, StateChanged):
                self._state_changed(event)
            elif isinstance(event, Fired):
                self._fired(event)
            elif isinstance(event, ShotFailed):
                self._shot_failed(event.shot, event.reason)
            elif isinstance(event, Arrival):
                self._arrived(event)
            elif isinstance(event, Companion):
                self._accompanied(event)
            elif isinstance(event, Deferred):
                self._deferred(event)
            elif isinstance(event, SettingsChanged):
                self._call(self._watchers.settings, event)
        except Exception as error:  # noqa: BLE001  # one event that goes wrong must not end the capture
            report(log, "capture", error)

    def _in_hand(self) -> bool:
        """Whether a shot is with the camera, and still worth waiting for."""
        waiting = any(story.open for story in list(self._stories.values()))
        return waiting and time.monotonic() < self._give_up_at

    def _state_changed(self, change: StateChanged) -> None:
        self.camera_state, self.camera_reason = change.state, change.reason
        self.identity = change.identity or self.identity
        if not self._stopping.is_set():
            self._call(self._watchers.camera, change)

    def _fired(self, event: Fired) -> None:
        self._book.fired(event)  # raises for a second time, or one after the file: the first word counts
        if story := self._stories.get(event.shot):
            story.fired = event
            story.ms["wish to trigger"] = (event.called_monotonic_ns - story.shot.wished_monotonic_ns) / 1e6
            story.ms["trigger call"] = (event.returned_monotonic_ns - event.called_monotonic_ns) / 1e6

    def _shot_failed(self, index: int, reason: str) -> None:
        story = self._stories.get(index)
        if story is not None and story.frame is not None:
            self._note("contradiction", f"its file is safe, and then the driver says: {reason}", index)
            return
        try:
            self._book.failed(index, reason)
        finally:
            if story is not None:
                self._fail(story, reason)

    def _arrived(self, arrival: Arrival) -> None:
        began = time.monotonic_ns()
        index = arrival.shot
        story = None if index is None else self._story(index)
        try:
            with self._publisher.giving_way() if self._publisher else nullcontext():
                frame = self._book.record(index, arrival.name, arrival.blob)
        except Exception as error:
            # The recorder has noted it as far as the disk lets it. A second file doesn't undo the first one.
            if story is not None and story.frame is None and not story.over:
                self._fail(story, sentence(error))
            raise
        finally:
            arrival.blob.close()
        self._call(self._camera.release, arrival)
        if story is None or story.frame is not None:
            return
        if story.follows:  # that one came to its end without the file, or is about to
            story = self._stories[frame.index] = Story(story.shot, story.fired, ms=story.ms, over=True)
        story.frame = frame
        if doubt := arrival.facts.get("doubt"):
            story.doubt = str(doubt)
            self._note("doubt", story.doubt, frame.index)
        if story.fired:
            story.ms["trigger to file"] = (arrival.monotonic_ns - story.fired.returned_monotonic_ns) / 1e6
        story.ms["record"] = (time.monotonic_ns() - began) / 1e6
        if self._following.pop(frame.index, None):
            self._note("followed", f"its file has come: {arrival.name}", frame.index)
        elif self._given_up.pop(frame.index, None):
            self._note("late", f"its file came after all; it had failed: {story.problem}", frame.index)
            story.problem = ""
            self._stories[frame.index] = story
        self._call(self._watchers.settled, frame.index, True)
        self._tag.put(story)

    def _story(self, index: int) -> Story | None:
        return self._stories.get(index) or self._given_up.get(index) or self._following.get(index)

    def _accompanied(self, companion: Companion) -> None:
        try:
            self._book.companion(companion.shot, companion.name, companion.blob)
        finally:
            companion.blob.close()
        self._call(self._camera.release, companion)

    def _deferred(self, event: Deferred) -> None:
        """The end of a shot whose file comes later: where it was exposed can be told now."""
        try:
            self._book.follows(event.shot, event.reason)
        finally:
            story = self._stories.get(event.shot)
            if story is not None and story.frame is None:
                story.follows = event.reason
                self._following[event.shot] = story
                self._call(self._watchers.settled, event.shot, False)
                self._tag.put(story)

    def _fail(self, story: Story, reason: str) -> None:
        """The end of a shot without a frame, for now: see `GIVEN_UP`."""
        index = story.shot.index
        story.problem = reason
        self._given_up[index] = story
        while len(self._given_up) > GIVEN_UP:
            del self._given_up[min(self._given_up)]
        self._call(self._watchers.settled, index, False)
        self._call(self._watchers.tagged, story)
        self._finish(story)

    # tag

    def _tag_one(self, story: Story) -> None:
        began = time.monotonic_ns()
        frame = story.frame
        if frame is None:
            story.where = self._poses(story.shot.index, self._expected(story, tagger.Settings()))
            self._call(self._watchers.tagged, story)
            self._finish(story)
            return
        settings = self._settings(frame)
        self._watch_zoom(frame, settings)
        exposure, pose = self._poses(frame.index, self._expected(story, settings))
        if story.fired and (told := camera_clock.shown(settings.taken)):
            self._camera_clock = self._camera_clock.learnt(*told, exposure)
        if story.doubt:
            exposure = replace(exposure, source=f"{exposure.source}; in doubt: {story.doubt}")
        camera = camera_name(self._names.camera, settings.model)
        story.tag = tagger.tag(frame, exposure, settings, camera=camera, mask=self._names.mask, pose=pose)
        self._book.tagged(story.tag)
        story.ms["tag"] = (time.monotonic_ns() - began) / 1e6
        self._call(self._watchers.tagged, story)
        if self._publisher:
            self._publisher.publish("frame", frame_header(story.tag, frame, self._names.law or None))
        if self._developer is None or not self.decoding:
            self._finish(story)
        else:
            self._decode.put(story)

    def _settings(self, frame: Frame) -> tagger.Settings:
        try:
            facts = rawfile.read_metadata(self._book.path(frame))
        except DappledError as error:
            self._note("unreadable", str(error), frame.index)
            return tagger.Settings()
        return tagger.Settings(
            facts.focal_length_mm, facts.f_number, facts.exposure_s, facts.iso, facts.model or "", facts.taken
        )

    def _watch_zoom(self, frame: Frame, settings: tagger.Settings) -> None:
        """A zoom that was changed in mid-flight moves every carrier: it is told."""
        if settings.focal_length_mm is None:
            return
        if self._zoom is not None and self._zoom[1] != settings.focal_length_mm:
            before, was_mm = self._zoom
            text = f"the focal length is {settings.focal_length_mm:g} mm; it was {was_mm:g} mm at frame {before}"
            log.warning("zoom: %s", text)
            self._note("zoom", text, frame.index)
        self._zoom = (frame.index, settings.focal_length_mm)

    def _expected(self, story: Story, settings: tagger.Settings) -> Exposure:
        """When the frame was exposed, as far as trigger call and file tell: by the trigger call and the body's latency;
        by the camera's own clock, where the driver never said when it fired; else by the wish."""
        if story.fired is not None:
            offset = story.shot.wished_utc_ns - story.shot.wished_monotonic_ns
            called_utc_ns = story.fired.called_monotonic_ns + offset
            return tagger.mid_exposure(called_utc_ns, self._latency, settings.exposure_s)
        told = camera_clock.shown(settings.taken)
        by_camera = told and camera_clock.exposure_from_camera(self._camera_clock, *told, settings.exposure_s)
        if by_camera:
            self._note("untimed", "the driver never said when it fired: the camera's clock is used", story.shot.index)
            return by_camera
        self._note("untimed", "the driver never said when it fired: the wish's time is used", story.shot.index)
        arrived_utc_ns = story.frame.arrived_utc_ns if story.frame else None
        return tagger.by_wish(story.shot.wished_utc_ns, arrived_utc_ns, self._latency, settings.exposure_s)

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

    # the ends of a story

    def _untagged(self, story: Story, error: Exception) -> None:
        self._call(self._watchers.tagged, story)
        self._leave(story, "not tagged", sentence(error))

    def _undecoded(self, story: Story, error: Exception) -> None:
        self._leave(story, "not decoded", sentence(error))

    def _drop(self, what: str) -> Callable[[Story], None]:
        return lambda story: self._leave(
            story, what, "the queue was full, or the flight ended; the frame is in the record"
        )

    def _leave(self, story: Story, what: str, why: str) -> None:
        """A safe frame goes no further down the street."""
        story.problem = f"{what}: {why}"
        self._note(what, why, story.shot.index)
        self._finish(story)

    def _finish(self, story: Story) -> None:
        if self._stories.get(story.shot.index) is story:
            del self._stories[story.shot.index]
        if not story.over:
            story.over = True
            self._call(self._watchers.finished, story)

    def _note(self, kind: str, text: str, index: int) -> None:
        """An event for the record, which goes on without it where the record refuses."""
        self._call(self._book.event, kind, text, index)

    def _call(self, told: Callable[..., Any], *facts: object) -> None:
        try:
            told(*facts)
        except Exception as error:  # noqa: BLE001  # whoever is told, the street goes on
            report(log, "street", error)
