"""The one-way street: camera events → record → tag → decode → publish, the same for a live flight and a replay.

Each crossing is a bounded queue (see `stages`). What differs between a flight and a replay is handed in: the camera,
the book that is written or compared, where poses come from.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import Capture
from dappled.daemon.pipeline.decode_process import FrameDecoder
from dappled.daemon.pipeline.decoding import Decoding
from dappled.daemon.pipeline.pending_shot import FlightWriter, Names, Observer, PendingShot, PoseSource
from dappled.daemon.pipeline.pending_shots import PendingShots
from dappled.daemon.pipeline.tagging import Tagging
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers.camera import BodyState, Camera
from dappled.errors import sentence
from dappled.flight import Shot
from dappled.workers import Worker

_TAG_QUEUE = 1000


class Pipeline:
    """Runs the stages. `decoder` None: frames are recorded and tagged, and decoded later."""

    def __init__(
        self,
        *,
        camera: Camera,
        writer: FlightWriter,
        poses: PoseSource,
        decoder: FrameDecoder | None,
        publisher: Publisher | None,
        latency: BodyLatency,
        names: Names,
        observer: Observer,
        decode_queue: int,
        preview_interval_s: float = 0.0,
    ) -> None:
        self._decodes = decoder is not None
        self.decoding = self._decodes  # off: frames are recorded and tagged, and decoded on the ground
        self._shots = PendingShots(writer, observer)
        tagging = Tagging(
            writer,
            self._shots,
            observer,
            publisher,
            poses=poses,
            latency=latency,
            names=names,
            hand_on=self._tagged,
        )
        decoding = decoder and Decoding(writer, self._shots, decoder, publisher, preview_interval_s)
        self._tag: Worker[PendingShot] = Worker(
            "tag",
            tagging.work,
            capacity=_TAG_QUEUE,
            on_failure=lambda pending, error: tagging.failed(pending, sentence(error)),
            on_drop=self._dropped("not tagged"),
        )
        self._decode: Worker[PendingShot] = Worker(
            "decode",
            decoding.work if decoding else self._shots.finish,
            capacity=decode_queue,
            on_failure=lambda pending, error: self._shots.leave(pending, "not decoded", sentence(error)),
            on_drop=self._dropped("not decoded"),
        )
        self._capture = Capture(camera, writer, self._shots, observer, self._tag.put)
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
        self._shots.expect(shot)

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

    def dead_threads(self) -> list[str]:
        """Which of the street's threads have ended without being asked to: none, unless there is a bug."""
        return [name for part in (self._capture, *self.stages) for name in part.dead_threads()]

    def decoding_idle(self, timeout_s: float = 5.0) -> bool:
        """Whether no frame waits to be decoded, at the latest after `timeout_s`."""
        return self._decode.wait_idle(timeout_s)

    def in_hand(self, index: int) -> bool:
        """Whether a shot is still on its way down the street, and not tagged yet."""
        pending = self._shots.in_hand(index)
        return pending is not None and pending.tag is None

    def _tagged(self, pending: PendingShot) -> None:
        if self.decoding:
            self._decode.put(pending)
        else:
            if self._decodes:
                self._shots.note("not decoded", "decoding was switched off", pending.shot.index)
            self._shots.finish(pending)

    def _dropped(self, what: str) -> Callable[[PendingShot], None]:
        why = "the queue was full, or the flight ended; the frame is in the record"
        return lambda pending: self._shots.leave(pending, what, why)
