"""The one-way street: camera events → record → tag → decode → publish, the same for a live flight and a replay.

Each crossing is a bounded queue (see `stages`). What differs between a flight and a replay is handed in: the camera,
the book that is written or compared, where poses come from.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from dappled.daemon.pipeline.capture import Capture
from dappled.daemon.pipeline.decode_process import Developer
from dappled.daemon.pipeline.decoding import Decoding
from dappled.daemon.pipeline.pending_shot import Book, Names, PoseSource, Story, Watchers
from dappled.daemon.pipeline.pending_shots import Stories
from dappled.daemon.pipeline.tagger import BodyLatency
from dappled.daemon.pipeline.tagging import Tagging
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers.camera import BodyState, Camera
from dappled.errors import sentence
from dappled.flight.records import Shot
from dappled.workers import Stage

_TAG_QUEUE = 1000


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
        self._decodes = developer is not None
        self.decoding = self._decodes  # off: frames are recorded and tagged, and decoded on the ground
        self._stories = Stories(book, watchers)
        tagging = Tagging(
            book,
            self._stories,
            watchers,
            publisher,
            poses=poses,
            latency=latency,
            names=names,
            hand_on=self._tagged,
        )
        decoding = developer and Decoding(book, self._stories, developer, publisher, preview_interval_s)
        self._tag: Stage[Story] = Stage(
            "tag",
            tagging.work,
            capacity=_TAG_QUEUE,
            on_failure=lambda story, error: tagging.failed(story, sentence(error)),
            on_drop=self._dropped("not tagged"),
        )
        self._decode: Stage[Story] = Stage(
            "decode",
            decoding.work if decoding else self._stories.finish,
            capacity=decode_queue,
            on_failure=lambda story, error: self._stories.leave(story, "not decoded", sentence(error)),
            on_drop=self._dropped("not decoded"),
        )
        self._capture = Capture(camera, book, self._stories, watchers, self._tag.put)
        self.stages = (self._tag, self._decode)

    def start(self) -> None:
        """Begin: the camera last, so that whatever it tells finds somebody at work."""
        for stage in self.stages:
            stage.start()
        self._capture.start()

    def stop(self, timeout_s: float) -> None:
        """Finish what is in hand, at most `timeout_s`; let go of the camera. What is left stays in the record, and a
        shot without a file has failed."""
        until = time.monotonic() + timeout_s
        self._capture.stop(timeout_s)
        for stage in self.stages:
            stage.stop(max(1.0, until - time.monotonic()))

    def expect(self, shot: Shot) -> None:
        """A shot was wished for and written down; `fire` follows."""
        self._stories.expect(shot)

    def fire(self, index: int) -> None:
        """Hand an expected shot to the camera. Never raises: a shot that the driver won't take has failed."""
        self._capture.fire(index)

    @property
    def camera_state(self) -> BodyState:
        """The camera's state, as it told last."""
        return self._capture.state

    @property
    def camera_reason(self) -> str:
        """Why it is in that state; "" where there is nothing to say."""
        return self._capture.reason

    def dead(self) -> list[str]:
        """Which of the street's threads have ended without being asked to: none, unless there is a bug."""
        return [name for part in (self._capture, *self.stages) for name in part.dead()]

    def decoding_idle(self, timeout_s: float = 5.0) -> bool:
        """Whether no frame waits to be decoded, at the latest after `timeout_s`."""
        return self._decode.wait_idle(timeout_s)

    def in_hand(self, index: int) -> bool:
        """Whether a shot is still on its way down the street, and not tagged yet."""
        story = self._stories.in_hand(index)
        return story is not None and story.tag is None

    def _tagged(self, story: Story) -> None:
        if self.decoding:
            self._decode.put(story)
        else:
            if self._decodes:
                self._stories.note("not decoded", "decoding was switched off", story.shot.index)
            self._stories.finish(story)

    def _dropped(self, what: str) -> Callable[[Story], None]:
        why = "the queue was full, or the flight ended; the frame is in the record"
        return lambda story: self._stories.leave(story, what, why)
