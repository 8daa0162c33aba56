"""Run the stages of a flight: camera events → record → tag → decode → publish, the same live and in a replay.

Between two stages stands a bounded queue (see `workers`). What differs between a flight and a replay is handed in: the
camera, the writer that records or compares, and the source of poses.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import Capture, Observer, PendingShot, PendingShots, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodedFrame, FrameDecoder
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.tagging import PoseSource, Tagging
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers.camera import Camera
from dappled.errors import sentence
from dappled.flight import Tag
from dappled.workers import Statistics, Worker

_TAG_QUEUE = 1000


class Pipeline:
    """Runs the stages over the shots of `shots`. `decoder` None: frames are recorded and tagged, and decoded later."""

    def __init__(
        self,
        camera: Camera,
        shots: PendingShots,
        writer: FlightWriter,
        poses: PoseSource,
        *,
        decoder: FrameDecoder | None,
        publisher: Publisher | None,
        latency: BodyLatency,
        names: Names,
        observer: Observer,
        decode_queue: int,
        preview_interval_s: float = 0.0,
    ) -> None:
        self._shots, self._decodes = shots, decoder is not None
        shots.decoding = self._decodes
        self._ends = ShotEnds(shots, writer, observer)
        tagging = Tagging(self._ends, poses, publisher, latency=latency, names=names, on_done=self._tagged)
        decoding = decoder and Decoding(self._ends, decoder, publisher, preview_interval_s)
        self._tag: Worker[PendingShot] = Worker(
            "tag",
            tagging.work,
            capacity=_TAG_QUEUE,
            on_failure=lambda pending, error: tagging.failed(pending, sentence(error)),
            on_drop=self._dropped("not tagged"),
        )
        self._decode: Worker[PendingShot] = Worker(
            "decode",
            decoding.work if decoding else self._ends.finish,
            capacity=decode_queue,
            on_failure=lambda pending, error: self._ends.leave(pending, "not decoded", sentence(error)),
            on_drop=self._dropped("not decoded"),
        )
        self._capture = Capture(camera, self._ends, self._tag.put)

    def start(self) -> None:
        """Start the last stage first and the camera last, so that each event finds its stage running."""
        self._tag.start()
        self._decode.start()
        self._capture.start()

    def stop(self, timeout_s: float) -> None:
        """Finish what is in hand, at most `timeout_s`, and release the camera. What is left stays in the record, and a
        shot without a file has failed."""
        until = time.monotonic() + timeout_s
        self._capture.stop(timeout_s)
        for stage in (self._tag, self._decode):
            stage.stop(max(1.0, until - time.monotonic()))

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped: none, unless there is a bug."""
        return [name for part in (self._capture, self._tag, self._decode) for name in part.dead_threads()]

    def statistics(self) -> tuple[Statistics, ...]:
        """Counters of each stage's queue."""
        return self._tag.statistics(), self._decode.statistics()

    def _tagged(self, pending: PendingShot) -> None:
        if self._shots.decoding:
            self._decode.put(pending)
        else:
            if self._decodes:
                self._ends.note("not decoded", "decoding was switched off", pending.shot.index)
            self._ends.finish(pending)

    def _dropped(self, what: str) -> Callable[[PendingShot], None]:
        why = "the queue was full, or the flight ended; the frame is in the record"
        return lambda pending: self._ends.leave(pending, what, why)


class Decoding:
    """Decode one shot's frame after the other, in one thread, and publish its slices.

    At most one preview is published in `preview_interval_s`.
    """

    def __init__(
        self, ends: ShotEnds, decoder: FrameDecoder, publisher: Publisher | None, preview_interval_s: float
    ) -> None:
        self._ends, self._decoder, self._publisher = ends, decoder, publisher
        self._preview_interval_s, self._last_preview_s = preview_interval_s, -1e9

    def work(self, pending: PendingShot) -> None:
        """Decode a tagged frame, record the result, publish it, and end the shot. Raises DecodeProcessError."""
        frame, tag = pending.frame, pending.tag
        assert frame is not None
        assert tag is not None
        began = time.monotonic_ns()
        writer = self._ends.writer
        decoded = self._decoder.develop(writer.path(frame), tag.focal_length_mm, tag.f_number)
        pending.decoded = decoded
        writer.decoded(decoded.result(frame.index, (time.monotonic_ns() - began) / 1e6))
        pending.ms["decode"] = (time.monotonic_ns() - began) / 1e6
        began = time.monotonic_ns()
        self._publish(tag, decoded)
        pending.ms["publish"] = (time.monotonic_ns() - began) / 1e6
        self._ends.finish(pending)

    def _publish(self, tag: Tag, decoded: DecodedFrame) -> None:
        if self._publisher is None:
            return
        self._publisher.publish("slices", wire.slices_header(tag, decoded), decoded.body)
        now_s = time.monotonic()
        if decoded.preview and now_s - self._last_preview_s >= self._preview_interval_s:
            self._last_preview_s = now_s
            facts = wire.frame_facts(tag, decoded.law)
            size = {"width": decoded.preview_size[0], "height": decoded.preview_size[1]}
            self._publisher.publish("preview", {**facts, "media_type": "image/jpeg", **size}, decoded.preview)
