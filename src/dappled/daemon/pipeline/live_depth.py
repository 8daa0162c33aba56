"""Depth in flight, where it is switched on: one frame now and then, after everything else, in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from dappled.daemon.pipeline.decode_process import FrameDepth
from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.daemon.stream import wire
from dappled.workers import Statistics, Worker

Publish = Callable[[str, Mapping[str, Any], Any], None]


class DepthMaker(Protocol):
    """What makes depth of a recorded frame: `DecodeProcess`."""

    def depth(self, path: str, focal_length_mm: float | None, f_number: float | None, method: str) -> FrameDepth:
        """Raises DecodeProcessError."""

    def close(self) -> None:
        """End, also in the middle of a frame."""


class LiveDepth:
    """Takes at most one finished frame in `interval_s`, the newest, and publishes its depth as topic `depth`. Owns the
    maker: a decoder of its own, as depth takes longer than a frame may wait."""

    def __init__(
        self,
        maker: DepthMaker,
        *,
        method: str,
        interval_s: float,
        path: Callable[[PendingShot], str],
        publish: Publish,
        give_way: Callable[[], object] = lambda: None,
        tell: Callable[[tuple[float, float]], object] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`path` says where a frame's file stands; `give_way` waits, bounded, while frames wait to be decoded; `tell`
        is given the nearest distance and its standard error in m, where they are known."""
        self._maker, self._method, self._interval_s = maker, method, interval_s
        self._path, self._publish, self._give_way, self._clock = path, publish, give_way, clock
        self._tell = tell
        self._last_s = -1e9
        self._stage: Worker[PendingShot] = Worker("depth", self._work, capacity=1, policy="drop oldest")

    def start(self) -> None:
        """Begin to work."""
        self._stage.start()

    def stop(self) -> None:
        """Take no more, and close the maker: what is in hand after half a second is given up."""
        self._stage.stop(0.5)
        self._maker.close()

    def dead_threads(self) -> list[str]:
        """See `Worker.dead_threads`."""
        return self._stage.dead_threads()

    def offer(self, pending: PendingShot) -> None:
        """A frame is finished; taken where one is due and it was decoded."""
        now_s = self._clock()
        if pending.decoded is not None and now_s - self._last_s >= self._interval_s:
            self._last_s = now_s
            self._stage.put(pending)

    def statistics(self) -> Statistics:
        """Counters."""
        return self._stage.statistics()

    def _work(self, pending: PendingShot) -> None:
        tag = pending.tag
        assert tag is not None  # decoded frames have one
        self._give_way()
        found = self._maker.depth(self._path(pending), tag.focal_length_mm, tag.f_number, self._method)
        facts = wire.frame_facts(tag, found.law)
        header = {
            **facts,
            "method": self._method,
            "range_px": found.range_px,
            "grid": found.grid,
            "arrays": found.arrays,
        }
        self._publish("depth", header, found.body)
        if found.nearest_m is not None:
            self._tell(found.nearest_m)
