"""Answer questions about recorded frames: tags from the ledger, slices decoded again from the record."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from dappled.clock import Clock
from dappled.daemon.stream.publisher import Reply
from dappled.daemon.stream.wire import DecodedSlices, Message, WireError, frame_header, slices_header
from dappled.errors import report, sentence
from dappled.flight import Frame, Tag
from dappled.workers import OneThread, Worker

log = logging.getLogger(__name__)
WAITING = 32


class FrameRecord(Protocol):
    """The recorded frames of a flight."""

    def frame(self, index: int) -> Frame | None:
        """A frame that is safe, None for an index without one."""

    def tag(self, index: int) -> Tag | None:
        """The tag of a frame, None while there is none."""

    def path(self, frame: Frame) -> str:
        """The path of the frame's file."""


class DecodedSlicesWithBody(DecodedSlices, Protocol):
    """A decoded frame: header entries and arrays."""

    @property
    def body(self) -> Any:
        """The arrays, end to end."""


class SlicesDecoder(Protocol):
    """Decodes a recorded frame again."""

    def decode(
        self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int
    ) -> DecodedSlicesWithBody:
        """Decode the raw file of frame `index` at `path`. Raises DappledError."""


class Answers(OneThread):
    """Answers questions one by one, behind a bounded queue; a question that finds it full is refused."""

    def __init__(
        self,
        record: FrameRecord,
        decoder: SlicesDecoder | None,
        wait_decoded: Callable[[], object] = lambda: None,
        *,
        clock: Clock | None = None,
    ) -> None:
        """`wait_decoded` waits, up to a limit, while the flight itself has frames to decode: they go before answers."""
        self._record, self._decoder, self._wait_decoded = record, decoder, wait_decoded
        self._worker: Worker[tuple[Mapping[str, Any], Reply]] = Worker(
            "answers", self._work, capacity=WAITING, on_failure=self._failed, clock=clock
        )
        self._loop = self._worker

    def stop(self) -> None:
        """Answer what waits, for a second at most, and end the thread."""
        self._worker.stop(1.0)

    def answer(self, request: Mapping[str, Any], reply: Reply) -> None:
        """Queue a question of `Publisher`. Raises WireError when too many wait already."""
        if not self._worker.put((request, reply)):
            raise WireError(f"{WAITING} questions are waiting already: ask again later")

    def _work(self, item: tuple[Mapping[str, Any], Reply]) -> None:
        request, reply = item
        reply(self._message(request["get"], request.get("frame")))

    def _message(self, topic: str, index: int | None) -> Message:
        if index is None:
            raise WireError("the flight has not started yet: ask again")
        frame, tag = self._record.frame(index), self._record.tag(index)
        if frame is None or tag is None:
            raise WireError(f"there is no frame {index} in this flight")
        if topic == "frame":
            return Message("frame", frame_header(tag, frame, None))
        if self._decoder is None:
            raise WireError("this flight is not decoded: no mask is configured")
        self._wait_decoded()
        decoded = self._decoder.decode(self._record.path(frame), tag.focal_length_mm, tag.f_number, index=index)
        return Message("slices", slices_header(tag, decoded), decoded.body)

    def _failed(self, item: tuple[Mapping[str, Any], Reply], error: Exception) -> None:
        report(log, "answers", error)
        item[1](Message("error", {"error": sentence(error)}))
