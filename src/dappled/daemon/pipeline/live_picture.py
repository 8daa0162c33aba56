"""Make pictures at the sensor's own resolution in flight, while somebody has subscribed to them."""

from __future__ import annotations

from dappled import codec
from dappled.daemon.pipeline.occasional import FinishedFrame, Occasional
from dappled.daemon.stream import wire


class LivePictures(Occasional):
    """Makes a frame's picture."""

    topic = "picture"

    def _wanted(self) -> bool:
        return self._publisher.wanted(self.topic)

    def _make(self, one: FinishedFrame) -> None:
        tag = one.tag
        made = self._maker.picture(one.path, tag.focal_length_mm, tag.f_number)
        header = {
            **wire.frame_facts(tag, one.law),
            "media_type": "image/jpeg",
            "width": made.size[0],
            "height": made.size[1],
            "corner": made.corner,
            "frame_shape": made.frame_shape,
            "shadow_from": made.shadow_from,
            "doubts": codec.plain(made.doubts),
        }
        self._publisher.publish(self.topic, header, made.jpeg)
