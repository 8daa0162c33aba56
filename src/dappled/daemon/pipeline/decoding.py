"""The decode stage: a tagged frame becomes slices, and those and their picture are published."""

from __future__ import annotations

import time

from dappled.daemon.pipeline.decode_process import DecodedFrame, FrameDecoder
from dappled.daemon.pipeline.pending_shot import FlightWriter, PendingShot
from dappled.daemon.pipeline.pending_shots import PendingShots
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Publisher
from dappled.daemon.stream.wire import slices_header
from dappled.flight import Tag


class Decoding:
    """Decodes one story's frame after the other, in one thread. Of the pictures at most one in `preview_interval_s` is
    published."""

    def __init__(
        self,
        writer: FlightWriter,
        shots: PendingShots,
        decoder: FrameDecoder,
        publisher: Publisher | None,
        preview_interval_s: float,
    ) -> None:
        self._writer, self._shots, self._decoder, self._publisher = writer, shots, decoder, publisher
        self._preview_interval_s, self._last_preview_s = preview_interval_s, -1e9

    def work(self, pending: PendingShot) -> None:
        """Decode a tagged frame, enter the result, publish it: the end of its story. Raises DecodeProcessError."""
        frame, tag = pending.frame, pending.tag
        assert frame is not None
        assert tag is not None
        began = time.monotonic_ns()
        decoded = self._decoder.develop(self._writer.path(frame), tag.focal_length_mm, tag.f_number)
        pending.decoded = decoded
        self._writer.decoded(decoded.result(frame.index, (time.monotonic_ns() - began) / 1e6))
        pending.ms["decode"] = (time.monotonic_ns() - began) / 1e6
        began = time.monotonic_ns()
        self._publish(tag, decoded)
        pending.ms["publish"] = (time.monotonic_ns() - began) / 1e6
        self._shots.finish(pending)

    def _publish(self, tag: Tag, decoded: DecodedFrame) -> None:
        if self._publisher is None:
            return
        self._publisher.publish("slices", slices_header(tag, decoded), decoded.body)
        now_s = time.monotonic()
        if decoded.preview and now_s - self._last_preview_s >= self._preview_interval_s:
            self._last_preview_s = now_s
            facts = wire.frame_facts(tag, decoded.law)
            size = {"width": decoded.preview_size[0], "height": decoded.preview_size[1]}
            self._publisher.publish("preview", {**facts, "media_type": "image/jpeg", **size}, decoded.preview)
