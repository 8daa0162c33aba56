"""Answers to questions about recorded frames: tags from the ledger, slices decoded again from the record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dappled.daemon.pipeline.decode_process import FrameDecoder
from dappled.daemon.pipeline.pending_shot import FlightWriter
from dappled.daemon.stream.headers import frame_header, slices_header
from dappled.daemon.stream.publisher import Reply
from dappled.daemon.stream.wire import Message, WireError
from dappled.errors import sentence
from dappled.workers import Worker

WAITING = 32


class Answers:
    """Works off questions one by one, behind a bounded queue; a question that finds it full is refused in words."""

    def __init__(
        self, book: FlightWriter, developer: FrameDecoder | None, give_way: Callable[[], object] = lambda: None
    ) -> None:
        """`give_way` waits, bounded, while the flight itself has something to decode: viewing comes after it."""
        self._book, self._developer, self._give_way = book, developer, give_way
        self._stage: Worker[tuple[Mapping[str, Any], Reply]] = Worker(
            "answers", self._work, capacity=WAITING, on_failure=self._failed
        )

    def start(self) -> None:
        """Begin to answer."""
        self._stage.start()

    def stop(self) -> None:
        """Answer what waits, within a second."""
        self._stage.stop(1.0)

    def dead_threads(self) -> list[str]:
        """See `Worker.dead_threads`."""
        return self._stage.dead_threads()

    def answer(self, request: Mapping[str, Any], reply: Reply) -> None:
        """For `Publisher`: raises WireError when too many questions wait already."""
        if not self._stage.put((request, reply)):
            raise WireError(f"{WAITING} questions wait already: ask again later")

    def _work(self, item: tuple[Mapping[str, Any], Reply]) -> None:
        request, reply = item
        reply(self._message(request["get"], request.get("frame")))

    def _message(self, topic: str, index: int | None) -> Message:
        if index is None:
            raise WireError("the flight has not started yet: ask again")
        frame, tag = self._book.frame(index), self._book.tag(index)
        if frame is None or tag is None:
            raise WireError(f"there is no frame {index} in this flight")
        if topic == "frame":
            return Message("frame", frame_header(tag, frame, None))
        if self._developer is None:
            raise WireError("this flight is not decoded: no mask is configured")
        self._give_way()
        decoded = self._developer.develop(self._book.path(frame), tag.focal_length_mm, tag.f_number)
        return Message("slices", slices_header(tag, decoded), decoded.body)

    def _failed(self, item: tuple[Mapping[str, Any], Reply], error: Exception) -> None:
        item[1](Message("error", {"error": sentence(error)}))
