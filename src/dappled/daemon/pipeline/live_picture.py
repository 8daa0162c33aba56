"""Make pictures at the sensor's own resolution in flight, while somebody has subscribed to them."""

from __future__ import annotations

from dappled import codec
from dappled.clock import Clock
from dappled.daemon.pipeline.capture import PendingShots
from dappled.daemon.pipeline.decode_process import DecodedFrame, DecodeProcess
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.pipeline.occasional import Occasional
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Stream
from dappled.flight import Tag

_TOPIC = "picture"


class LivePictures(Occasional):
    """Publishes a frame's picture as topic `picture`."""

    def __init__(
        self,
        maker: DecodeProcess,
        writer: FlightWriter,
        shots: PendingShots,
        publisher: Stream,
        *,
        interval_s: float,
        clock: Clock,
    ) -> None:
        super().__init__(_TOPIC, maker, writer, shots, interval_s=interval_s, clock=clock)
        self._publisher = publisher

    def _wanted(self) -> bool:
        return self._publisher.wanted(_TOPIC)

    def _make(self, path: str, tag: Tag, decoded: DecodedFrame) -> None:
        made = self._maker.picture(path, tag.focal_length_mm, tag.f_number)
        header = {
            **wire.frame_facts(tag, decoded.law),
            "media_type": "image/jpeg",
            "width": made.size[0],
            "height": made.size[1],
            "corner": made.corner,
            "frame_shape": made.frame_shape,
            "shadow_from": made.shadow_from,
            "doubts": codec.plain(made.doubts),
        }
        self._publisher.publish(_TOPIC, header, made.jpeg)
