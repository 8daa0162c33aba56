"""What is made of a frame now and then, for viewers: after decoding, in a process of its own."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from dappled.daemon.pipeline.capture import PendingShot, PendingShots
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.stream.publisher import Stream
from dappled.flight import Tag
from dappled.workers import OneThread, Worker


class FinishedFrame(NamedTuple):
    """What is kept of a frame until something is made of it: where its file is, its tag, and the law it was decoded by.
    Not its slices, which are as large as the frame."""

    path: str
    tag: Tag
    law: str


class Occasional(OneThread, ABC):
    """Publishes as `topic` what it makes of at most one finished frame in `interval_s`, the newest, when no frame is to
    be decoded.

    `maker` is a decode process for viewers alone, as what they get takes longer than a frame may wait; several parts
    may share it.
    """

    topic: ClassVar[str]

    def __init__(
        self,
        maker: DecodeProcess,
        writer: FlightWriter,
        shots: PendingShots,
        publisher: Stream,
        *,
        interval_s: float,
    ) -> None:
        self._maker, self._writer, self._shots, self._publisher = maker, writer, shots, publisher
        self._interval_s, self._clock = interval_s, shots.clock
        self._last_ns: int | None = None
        self._unseen: FinishedFrame | None = None  # the newest frame, since when nobody would have seen what is made
        self._choosing = threading.Lock()
        self._worker: Worker[FinishedFrame] = Worker(
            self.topic, self._work, capacity=1, policy="drop oldest", clock=self._clock
        )
        self._loop = self._worker

    def stop(self) -> None:
        """Take no more frames and close the maker. A frame in hand is given up after half a second."""
        self._worker.stop(0.5)
        self._maker.close()

    def offer(self, pending: PendingShot) -> None:
        """Take a finished frame, if one is due and it was decoded."""
        if (decoded := pending.decoded) is not None:
            assert pending.frame is not None  # a decoded shot has all three
            assert pending.tag is not None
            self._choose(FinishedFrame(self._writer.path(pending.frame), pending.tag, decoded.law))

    def look(self) -> None:
        """Take the newest frame, if nobody would have seen what is made of it when it came, and somebody does now."""
        if (newest := self._unseen) is not None:
            self._choose(newest)

    def _choose(self, one: FinishedFrame) -> None:
        with self._choosing:
            now_ns, wanted = self._clock.monotonic_ns(), self._wanted()
            due = self._last_ns is None or now_ns - self._last_ns >= round(self._interval_s * 1e9)
            if due and wanted:
                self._last_ns = now_ns
                self._worker.put(one)
            self._unseen = None if wanted else one

    def _wanted(self) -> bool:
        """Whether somebody would see what is made."""
        return True

    def _work(self, one: FinishedFrame) -> None:
        self._shots.wait_decoded()
        self._make(one)

    @abstractmethod
    def _make(self, one: FinishedFrame) -> None:
        """Make it of the frame's file, and publish it. Raises DecodeProcessError."""
