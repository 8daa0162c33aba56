"""Estimate depth in flight, where it is switched on."""

from __future__ import annotations

from collections.abc import Callable

from dappled import codec
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.pipeline.occasional import FinishedFrame, Occasional
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Stream


class LiveDepth(Occasional):
    """Estimates a frame's depth. `nearest` gets the nearest distance and its standard error in m, where they are
    known."""

    topic = "depth"

    def __init__(
        self,
        maker: DecodeProcess,
        writer: FlightWriter,
        shots: PendingShots,
        publisher: Stream,
        *,
        method: str,
        interval_s: float,
        nearest: Callable[[tuple[float, float]], None] | None = None,
    ) -> None:
        super().__init__(maker, writer, shots, publisher, interval_s=interval_s)
        self._method, self._nearest = method, nearest

    def _make(self, one: FinishedFrame) -> None:
        tag = one.tag
        found = self._maker.depth(one.path, tag.focal_length_mm, tag.f_number, self._method)
        header = {
            **wire.frame_facts(tag, found.law),
            "method": self._method,
            "range_px": found.range_px,
            "grid": found.grid,
            "arrays": found.arrays,
            "doubts": codec.plain(found.doubts),
        }
        self._publisher.publish(self.topic, header, found.body)
        if found.nearest_m is not None and self._nearest is not None:
            self._nearest(found.nearest_m)
