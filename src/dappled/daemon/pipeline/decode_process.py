"""Decode in a separate process, so that a crash of LibRaw or a slow decode can't disturb the capture.

The worker (`dappled.daemon.pipeline.decode_worker`) runs at low priority and hands its arrays back in a memfd,
without a copy.
"""

from __future__ import annotations

import logging
import mmap
import os
import socket
import subprocess
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from dappled import codec
from dappled.clock import Clock, SystemClock
from dappled.daemon.pipeline.picture_facts import PictureFacts
from dappled.drivers.child_process import (
    DECODER_GOES,
    ChannelError,
    ChannelMessage,
    MessageSizeError,
    ProcessChannel,
    RestartBudget,
    end_child,
    how_ended,
    start_child,
)
from dappled.drivers.raw.recipe import LawDecision, Recipe
from dappled.errors import DappledError
from dappled.findings import Finding
from dappled.flight import Result
from dappled.flight.flight_mask import FlightMask
from dappled.workers import Loop

log = logging.getLogger(__name__)
NICENESS = 10
_LOOK_S = 0.1
_SEND_S = 5.0


class DecodeProcessError(DappledError):
    """A frame can't be decoded; one sentence. The frame stays in the record."""


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """What came out of a frame. `body` holds the arrays of `arrays` end to end, `sha256` is the body's.

    `carriers` are rows [ky, kx, fy, fx]; `grid` (2, 3) leads from (y, x, 1) of a slice to sensor (row, column).
    `preview` is a JPEG of `preview_size` (width, height). `ms` names what took how long. `seen` is what viewers need
    besides, in the words of the `slices` schema. `carriers_found` is None where no carriers can be seen at the frame's
    aperture, `decision` the law for the flight where this frame decided it; `fingerprint` see
    `decode.lightfield.light_field.fingerprint`. `picture` is what the frame is judged by, `mask_nats` the log odds that
    the mask is where it was calibrated (None: nothing tells), `about_flight` what all frames so far tell together.
    """

    body: mmap.mmap
    sha256: str
    arrays: list[dict[str, Any]]
    carriers: list[list[float]]
    carriers_from: str
    carriers_found: int | None
    carriers_predicted: int
    law: str
    grid: list[list[float]]
    preview: bytes
    preview_size: tuple[int, int]
    ms: Mapping[str, float] = field(default_factory=dict)
    seen: Mapping[str, Any] = field(default_factory=dict)
    doubts: tuple[Finding, ...] = ()
    decision: LawDecision | None = None
    fingerprint: Mapping[str, Any] | None = None
    picture: PictureFacts | None = None
    mask_nats: float | None = None
    about_flight: tuple[Finding, ...] = ()

    def result(
        self, index: int, decode_ms: float | None, run: str = "live", judged: Mapping[str, Any] | None = None
    ) -> Result:
        """The row of the ledger; `judged` are the values of the frame's verdict."""
        details: dict[str, Any] = {"ms": dict(self.ms)}
        if self.doubts:
            details["doubts"] = codec.plain(self.doubts)
        if self.fingerprint is not None:
            details["fingerprint"] = dict(self.fingerprint)
        if judged is not None:
            details["verdict"] = dict(judged)
        if self.mask_nats is not None:
            details["mask_nats"] = self.mask_nats
        return Result(
            index,
            self.sha256,
            self.carriers_found,
            self.carriers_predicted,
            self.law,
            self.carriers_from,
            decode_ms,
            run,
            details,
        )


@dataclass(frozen=True, slots=True)
class FrameDepth:
    """Depth of one frame. `body` holds disparity and sigma, float32 (h, w) each, as `arrays` says; `range_px` the 2nd
    and 98th percentile of the known disparities, None where none is known; `grid` as in DecodedFrame. `nearest_m` is
    the nearest distance and its standard error, None where no calibration leads to metres or too little is known;
    `doubts` what may be wrong with the frame."""

    body: mmap.mmap
    arrays: list[dict[str, Any]]
    range_px: list[float] | None
    grid: list[list[float]]
    law: str
    nearest_m: tuple[float, float] | None = None
    doubts: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class FramePicture:
    """The picture of one frame at the sensor's own resolution: a JPEG of `size` (width, height), which begins at row
    and column `corner` of a frame of `frame_shape`. `shadow_from` see `ShadowFrom`, `doubts` what speaks against it."""

    jpeg: bytes
    size: tuple[int, int]
    corner: tuple[int, int]
    frame_shape: tuple[int, int]
    shadow_from: str
    doubts: tuple[Finding, ...] = ()


class FrameDecoder(Protocol):
    """Decodes recorded frames, for the pipeline and for answers to subscribers."""

    def decode(
        self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int, look: bool = False
    ) -> DecodedFrame:
        """Decode the raw file of frame `index` at `path`. With `look` it may decide by which law the flight goes on.
        Raises DecodeProcessError."""


class DecodeProcess:
    """Decodes in a worker process, one frame at a time; a worker that dies or hangs is replaced.

    `timeout_s` bounds one frame. Threads may share it: they take turns. A worker that keeps dying is started six times
    a minute at most; frames in between are not decoded, and say why. `goes_first` as for `start_child`.
    """

    def __init__(
        self,
        recipe: Recipe,
        *,
        timeout_s: float = 60.0,
        preview_px: int = 1024,
        budget: RestartBudget | None = None,
        clock: Clock | None = None,
        goes_first: int = DECODER_GOES,
    ) -> None:
        self._goes_first = goes_first
        self._recipe, self._timeout_s, self._preview_px = recipe, timeout_s, preview_px
        self._budget, self._clock = budget or RestartBudget(limit=6, window_s=60.0), clock or SystemClock()
        self._turn = threading.Lock()
        self._mask = FlightMask()
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: ProcessChannel | None = None
        self._closed, self._may_look = False, True

    def warm_up(self) -> None:
        """Start the worker now, so that the first frame doesn't wait for it. Raises DecodeProcessError for a recipe
        that can't work."""
        with self._turn:
            self._ask({"do": "warm up"})

    def begin_warm_up(self) -> None:
        """The same in a thread of its own; a failure is logged."""
        Loop("decoder warm-up", self._warm_up).start()

    def _warm_up(self) -> None:
        try:
            self.warm_up()
        except DecodeProcessError as error:
            if not self._closed:
                log.warning("decoding will fail: %s", error)

    def decode(
        self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int, look: bool = False
    ) -> DecodedFrame:
        """Decode the raw file of frame `index` at `path`."""
        frame = {"path": path, "focal_length_mm": focal_length_mm, "f_number": f_number, "index": index}
        with self._turn:
            look = look and self._may_look
            try:
                decoded = _decoded(self._ask({"do": "decode", "look": look, **frame}))
            except DecodeProcessError:
                self._may_look = self._may_look and not (look and self._process is None)  # it may have died of a search
                raise
            self._mask.add(index, decoded.mask_nats)
            doubts = self._mask.relieved(decoded.doubts)
            decoded = replace(decoded, doubts=doubts, about_flight=self._mask.unseen)
            if decoded.decision in (None, self._recipe.decided):
                return replace(decoded, decision=None)
            self._recipe = replace(self._recipe, decided=decoded.decision)  # a worker that takes over goes on by it
        return decoded

    def depth(self, path: str, focal_length_mm: float | None, f_number: float | None, method: str) -> FrameDepth:
        """Decode a frame with its views, and estimate its depth. Raises DecodeProcessError."""
        facts = {"path": path, "focal_length_mm": focal_length_mm, "f_number": f_number, "method": method}
        with self._turn:
            answer = self._ask({"do": "depth", **facts})
        (body_fd,) = answer.fds
        try:
            body = _mapped(body_fd)
        finally:
            os.close(body_fd)
        depth = answer.body
        nearest = depth["nearest_m"]
        pair = None if nearest is None else (float(nearest[0]), float(nearest[1]))
        return FrameDepth(
            body,
            depth["arrays"],
            depth["range_px"],
            depth["grid"],
            depth["law"],
            pair,
            codec.read(tuple[Finding, ...], depth["doubts"]),
        )

    def picture(self, path: str, focal_length_mm: float | None, f_number: float | None) -> FramePicture:
        """Make a frame's picture at the sensor's own resolution, of its middle where it is large. Raises
        DecodeProcessError."""
        facts = {"path": path, "focal_length_mm": focal_length_mm, "f_number": f_number}
        with self._turn:
            answer = self._ask({"do": "picture", **facts})
        (jpeg_fd,) = answer.fds
        made = answer.body
        (width, height), (row, column), (rows, columns) = (made[name] for name in ("size", "corner", "frame_shape"))
        doubts = codec.read(tuple[Finding, ...], made["doubts"])
        return FramePicture(
            _read(jpeg_fd), (width, height), (row, column), (rows, columns), made["shadow_from"], doubts
        )

    def close(self) -> None:
        """End the worker, also in the middle of a frame, which then is not decoded."""
        self._closed = True
        if not self._turn.acquire(timeout=0):
            while not self._turn.acquire(timeout=_LOOK_S):
                if process := self._process:
                    process.kill()
        self._end()
        self._turn.release()

    def _ask(self, question: Mapping[str, Any]) -> ChannelMessage:
        stopped = f"{question.get('path', 'the recipe')} was not decoded: the decoder was stopped"
        if self._closed:
            raise DecodeProcessError(stopped)
        if self._process is not None and self._process.poll() is not None:
            self._end()  # it died between two frames: neither is to blame
        try:
            channel = self._channel or self._begin()
            channel.send(question, timeout_s=_SEND_S)
            answer = channel.receive(self._timeout_s)
        except ChannelError:
            code = self._end()
            if self._closed:  # `close` has killed it
                raise DecodeProcessError(stopped) from None
            on = question.get("path", "start")
            raise DecodeProcessError(f"the decoder died ({how_ended(code)}) on {on}") from None
        except OSError as error:
            self._end()
            raise DecodeProcessError(f"the decoder's process can't be started: {error.strerror}") from None
        if answer is None:
            self._end()
            raise DecodeProcessError(
                f"decoding {question.get('path', '')} took over {self._timeout_s:g} s and was given up"
            )
        if "error" in answer.body:
            raise DecodeProcessError(str(answer.body["error"]))
        if answer.lost:
            raise DecodeProcessError(f"what {question['path']} was decoded to could not be received: {answer.lost}")
        return answer

    def _begin(self) -> ProcessChannel:
        if wait_ns := self._budget.wait_ns(self._clock.monotonic_ns()):
            raise DecodeProcessError(
                f"the decoder keeps crashing: it starts again in {wait_ns / 1e9:.0f} s; frames stay in the record"
            )
        self._budget.spend(self._clock.monotonic_ns())
        self._process, self._channel = start_child(
            "dappled.daemon.pipeline.decode_worker", goes_first=self._goes_first, niceness=NICENESS
        )
        self._channel.send({"do": "set up", "recipe": codec.plain(self._recipe), "preview_px": self._preview_px})
        return self._channel

    def _end(self) -> int | None:
        if self._channel is not None:
            self._channel.close()
        process, self._process, self._channel = self._process, None, None
        if process is None:
            return None
        end_child(process, 0.5)
        return process.returncode


def _mapped(fd: int) -> mmap.mmap:
    try:
        return mmap.mmap(fd, 0, prot=mmap.PROT_READ)
    except OSError as error:  # no descriptors, no memory
        raise DecodeProcessError(f"a decoded frame can't be mapped into memory: {error.strerror}") from None


def _read(fd: int) -> bytes:
    """All bytes of a file, which is closed."""
    with open(fd, "rb") as file:
        file.seek(0)
        return file.read()


def _decoded(answer: ChannelMessage) -> DecodedFrame:
    facts = answer.body
    body_fd, preview_fd = answer.fds
    preview = _read(preview_fd)
    try:
        body = _mapped(body_fd)
    finally:
        os.close(body_fd)
    width, height = facts["preview_size"]
    records: dict[str, Any] = {
        "doubts": codec.read(tuple[Finding, ...], facts["doubts"]),
        "decision": facts["decision"] and codec.read(LawDecision, facts["decision"]),
        "picture": _picture(facts["picture"]),
    }
    return DecodedFrame(body=body, preview=preview, **{**facts, "preview_size": (width, height), **records})


def _picture(values: Mapping[str, Any] | None) -> PictureFacts | None:
    try:
        return None if values is None else codec.read(PictureFacts, values)
    except codec.CodecError as error:  # a frame must not be lost with what only its verdict needs
        log.warning("a frame can't be judged: its facts can't be read: %s", error)
        return None


def _send(channel: ProcessChannel, question: ChannelMessage, body: Mapping[str, Any], fds: tuple[int, ...]) -> None:
    """Send an answer, or why it can't be sent. Raises ChannelError."""
    try:
        channel.send(body, fds, timeout_s=_SEND_S)
    except MessageSizeError as error:
        what = question.body.get("path", "the recipe")
        channel.send({"error": f"what {what} was decoded to can't be reported: {error}"}, timeout_s=_SEND_S)


Serve = Callable[[ChannelMessage], tuple[Mapping[str, Any], tuple[int, ...]]]


def serve(end: socket.socket, answer: Serve) -> None:
    """The worker's loop: one answer a question, until the other end closes."""
    channel = ProcessChannel(end)
    while True:
        try:
            question = channel.receive(3600)
            if question is None:
                continue
            body, fds = answer(question)
            if body:
                _send(channel, question, body, fds)
        except ChannelError:
            return
        for fd in fds:
            os.close(fd)
