"""Estimate depth in flight, where it is switched on: one frame now and then, after decoding, in its own process."""

from __future__ import annotations

from collections.abc import Callable

from dappled import codec
from dappled.clock import Clock
from dappled.daemon.pipeline.capture import PendingShot, PendingShots
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Stream
from dappled.workers import OneThread, Worker


class LiveDepth(OneThread):
    """Takes at most one finished frame in `interval_s`, the newest, and publishes its depth as topic `depth`.

    Owns `maker`: a decode process of its own, as depth takes longer than a frame may wait. `nearest` gets the
    nearest distance and its standard error in m, where they are known.
    """

    def __init__(
        self,
        maker: DecodeProcess,
        writer: FlightWriter,
        shots: PendingShots,
        publisher: Stream,
        *,
        method: str,
        interval_s: float,
        clock: Clock,
        nearest: Callable[[tuple[float, float]], None] | None = None,
    ) -> None:
        self._maker, self._writer, self._shots, self._publisher = maker, writer, shots, publisher
        self._method, self._interval_s, self._clock, self._nearest = method, interval_s, clock, nearest
        self._last_ns: int | None = None
        self._worker: Worker[PendingShot] = Worker("depth", self._work, capacity=1, policy="drop oldest", clock=clock)
        self._loop = self._worker

    def stop(self) -> None:
        """Take no more frames and close the maker. A frame in hand is given up after half a second."""
        self._worker.stop(0.5)
        self._maker.close()

    def offer(self, pending: PendingShot) -> None:
        """Take a finished frame, if one is due and it was decoded."""
        now_ns = self._clock.monotonic_ns()
        due = self._last_ns is None or now_ns - self._last_ns >= round(self._interval_s * 1e9)
        if due and pending.decoded is not None:
            self._last_ns = now_ns
            self._worker.put(pending)

    def _work(self, pending: PendingShot) -> None:
        frame, tag = pending.frame, pending.tag
        assert frame is not None  # a decoded shot has both
        assert tag is not None
        self._shots.wait_decoded()
        found = self._maker.depth(self._writer.path(frame), tag.focal_length_mm, tag.f_number, self._method)
        header = {
            **wire.frame_facts(tag, found.law),
            "method": self._method,
            "range_px": found.range_px,
            "grid": found.grid,
            "arrays": found.arrays,
            "doubts": codec.plain(found.doubts),
        }
        self._publisher.publish("depth", header, found.body)
        if found.nearest_m is not None and self._nearest is not None:
            self._nearest(found.nearest_m)
