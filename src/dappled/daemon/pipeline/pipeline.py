"""Run the stages of a flight: camera events → record → tag → decode → publish, the same live and in a replay.

Between two stages stands a bounded queue (see `workers`). What differs between a flight and a replay is handed in: the
camera, the writer that records or compares, and the source of poses.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import Capture, PendingShot, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodedFrame, FrameDecoder
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.tagging import PoseSource, Tagging
from dappled.daemon.pipeline.verdicts import Judge, Verdict, VerdictCounts, unjudged
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Stream
from dappled.drivers.raw.recipe import LawDecision
from dappled.errors import report
from dappled.findings import FRAME, Code, Evidence, Finding, Level, Subject, finding
from dappled.flight import Tag
from dappled.flight.records import LEFT
from dappled.workers import Statistics, Worker

log = logging.getLogger(__name__)
_DECODING = Subject("decoding")
_FAILING = 3  # so many frames in a row that can't be decoded are no accident


@dataclass(frozen=True, slots=True)
class DecodeFailures:
    """The frames that could not be decoded: how many, how many since the last one that could, and the last of them as
    a finding (fact `why`); and what was found of the last decoded one."""

    count: int = 0
    in_a_row: int = 0
    last: Finding | None = None
    found: tuple[Finding, ...] = ()

    def findings(self) -> list[Finding]:
        """That frames could not be decoded."""
        if self.last is None:
            return []
        if self.in_a_row < _FAILING:
            return [self.last]
        return [finding(Code.DECODE_FAILING, _DECODING, in_a_row=self.in_a_row, why=self.last.facts["why"])]

    def after(self, why: Evidence) -> DecodeFailures:
        """With one more."""
        last = finding(Code.DECODE_FAILED, _DECODING, frames=self.count + 1, why=why)
        return replace(self, count=self.count + 1, in_a_row=self.in_a_row + 1, last=last)


class Pipeline:
    """Runs the stages over the shots of `decoding`, its last stage."""

    def __init__(self, decoding: Decoding, poses: PoseSource, latency: BodyLatency, names: Names) -> None:
        self._clock = decoding.ends.shots.clock
        self._decoding = decoding
        self._tagging = Tagging(
            decoding.ends, poses, decoding.publisher, latency=latency, names=names, following=decoding
        )
        self._capture = Capture(decoding.ends, self._tagging)

    def start(self) -> None:
        """Start the last stage first and the camera last, so that each event finds its stage running."""
        self._decoding.worker.start()
        self._tagging.worker.start()
        self._capture.start()

    def stop(self, timeout_s: float) -> None:
        """Finish what is in hand, at most `timeout_s`, and release the camera. What is left stays in the record, and a
        shot without a file has failed."""
        until_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        self._capture.stop(timeout_s)
        for stage in (self._tagging, self._decoding):
            stage.worker.stop(max(1.0, (until_ns - self._clock.monotonic_ns()) / 1e9))

    def dead_threads(self) -> list[str]:
        """The threads that have ended without having been stopped: none, unless there is a bug."""
        return [
            name
            for part in (self._capture, self._tagging.worker, self._decoding.worker)
            for name in part.dead_threads()
        ]

    @property
    def decode_failures(self) -> DecodeFailures:
        """What could not be decoded so far. Frames that decoding had no time for are none of these."""
        return self._decoding.failures

    @property
    def verdicts(self) -> VerdictCounts:
        """How the frames were judged so far."""
        return self._decoding.judge.counts

    def statistics(self) -> tuple[Statistics, ...]:
        """Counters of each stage's queue."""
        return self._tagging.worker.statistics(), self._decoding.worker.statistics()


class Decoding:
    """Decode one shot's frame after the other, in one thread, and publish its slices. `decoder` None: frames are
    recorded and tagged, and decoded later.

    At most one preview is published in `preview_interval_s`.
    """

    def __init__(
        self,
        ends: ShotEnds,
        decoder: FrameDecoder | None,
        publisher: Stream | None,
        *,
        capacity: int,
        judge: Judge,
        preview_interval_s: float = 0.0,
    ) -> None:
        ends.shots.decoding = decoder is not None
        self.ends, self.publisher = ends, publisher
        self._decoder = decoder
        self._clock = ends.shots.clock
        self._preview_interval_s, self._last_preview_s = preview_interval_s, -1e9
        self.failures = DecodeFailures()
        self.judge = judge
        self._unrecorded: LawDecision | None = None
        self.worker: Worker[PendingShot] = Worker(
            "decode",
            self._work,
            capacity=capacity,
            on_failure=self._failed,
            on_drop=self._dropped,
            clock=self._clock,
        )

    def take(self, pending: PendingShot) -> None:
        """Queue a shot. A frame that is not to be decoded comes to its end here."""
        if self._decoder is None:
            self.ends.finish(pending)
        elif self.ends.shots.decoding:
            self.worker.put(pending)
        else:
            off = finding(Code.FRAME_UNDECODED, FRAME, Level.NOTE, why=finding(Code.DECODE_SWITCHED_OFF, FRAME))
            self._unjudged(pending, off)
            self.ends.note(LEFT, off, pending.shot.index)
            self.ends.finish(pending)

    def _work(self, pending: PendingShot) -> None:
        """Decode a tagged frame, record the result, publish it, and end the shot. Raises DecodeProcessError."""
        frame, tag = pending.frame, pending.tag
        assert frame is not None
        assert tag is not None
        assert self._decoder is not None
        began = self._clock.monotonic_ns()
        writer = self.ends.writer
        decoded = self._decoder.decode(
            writer.path(frame), tag.focal_length_mm, tag.f_number, index=frame.index, look=True
        )
        law = decoded.decision
        decided = () if law is None else (law.found,)
        self.failures = replace(self.failures, in_a_row=0, found=(*decoded.doubts, *decoded.about_flight, *decided))
        pending.decoded = decoded
        self._unrecorded = decoded.decision or self._unrecorded
        if self._unrecorded is not None:  # tried again with the next frame where the disk refuses
            writer.law_decided(self._unrecorded)
            self._unrecorded = None
        pending.verdict = self._judged(pending, tag, decoded)
        judged = pending.verdict.values()
        writer.decoded(decoded.result(frame.index, (self._clock.monotonic_ns() - began) / 1e6, judged=judged))
        pending.ms["decode"] = (self._clock.monotonic_ns() - began) / 1e6
        began = self._clock.monotonic_ns()
        self._publish(tag, decoded, judged)
        pending.ms["publish"] = (self._clock.monotonic_ns() - began) / 1e6
        self.ends.finish(pending)

    def _judged(self, pending: PendingShot, tag: Tag, decoded: DecodedFrame) -> Verdict:
        try:
            found = self.judge.judge(
                tag,
                pending.rates_rad_s,
                decoded.picture,
                carriers=(decoded.carriers_found, decoded.carriers_predicted),
                doubts=decoded.doubts,
            )
            json.dumps(found.values(), allow_nan=False)  # what the ledger can't hold is no verdict
        except Exception as error:  # noqa: BLE001  # a decoded frame must not be lost with its verdict
            report(log, "verdict", error)
            found = unjudged(error)
        return self.judge.count(tag.index, found, (tag.focal_length_mm, tag.f_number))

    def _unjudged(self, pending: PendingShot, why: Finding) -> None:
        if pending.verdict is None:
            found = unjudged(why)
            pending.verdict = self.judge.count(pending.shot.index, found)

    def _failed(self, pending: PendingShot, error: Exception) -> None:
        report(log, f"decode of frame {pending.shot.index}", error)
        self.failures = self.failures.after(error)
        self._leave(pending, error)

    def _dropped(self, pending: PendingShot) -> None:
        self._leave(pending, finding(Code.QUEUE_FULL, FRAME))

    def _leave(self, pending: PendingShot, why: Evidence) -> None:
        self._unjudged(pending, finding(Code.FRAME_UNDECODED, FRAME, why=why))
        self.ends.leave(pending, Code.FRAME_UNDECODED, why)

    def _publish(self, tag: Tag, decoded: DecodedFrame, judged: Mapping[str, Any]) -> None:
        if self.publisher is None:
            return
        self.publisher.publish("slices", {**wire.slices_header(tag, decoded), "verdict": judged}, decoded.body)
        now_s = self._clock.monotonic_ns() / 1e9
        if decoded.preview and now_s - self._last_preview_s >= self._preview_interval_s:
            self._last_preview_s = now_s
            facts = wire.frame_facts(tag, decoded.law)
            size = {"width": decoded.preview_size[0], "height": decoded.preview_size[1]}
            self.publisher.publish("preview", {**facts, "media_type": "image/jpeg", **size}, decoded.preview)
