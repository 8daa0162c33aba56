"""Watch a stream to its end: count each frame once, however often it comes, and save its slices."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from dappled.clock import Clock
from dappled.daemon.stream.subscriber import Subscriber
from dappled.daemon.stream.wire import Message
from dappled.decode.lightfield.light_field import slice_mosaic

_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class Watched:
    """For how many frames slices came, how many messages came in all, and whether the flight has ended."""

    frames: int
    messages: int
    ended: bool

    def short_of(self, count: int | None) -> bool:
        """Whether fewer than `count` frames came; without a count, whether none came and the flight has not ended."""
        if count is None:
            return not self.ended and not self.frames
        return self.frames < count


def watch(
    stream: Subscriber,
    *,
    received: Callable[[Message], None],
    new_frame: Callable[[Message], None],
    count: int | None = None,
    silence_s: float | None = None,
    clock: Clock,
) -> Watched:
    """Receive until the slices of `count` frames have come, the flight has ended and no answer is outstanding, or no
    message came for `silence_s`. `received` gets every message, `new_frame` the first slices of each frame."""
    frames: set[tuple[str, int]] = set()
    messages, ended = 0, False
    last_ns = clock.monotonic_ns()
    while not (ended and not stream.waiting_for) and (count is None or len(frames) < count):
        message = stream.receive(_LOOK_S)
        if message is None:
            if silence_s and clock.monotonic_ns() - last_ns > silence_s * 1e9:
                break
            continue
        last_ns, messages = clock.monotonic_ns(), messages + 1
        ended = ended or message.topic == "end"
        received(message)
        if message.topic == "slices":
            frame = (message.header["flight"], message.header["frame"])
            if frame not in frames:
                frames.add(frame)
                new_frame(message)
    return Watched(len(frames), messages, ended)


def save(message: Message, folder: Path) -> None:
    """Save the header as JSON, the slices as NPY and their mosaic (Fig 43) as PNG, named by the frame."""
    stem = folder / f"{message.header['frame']:06d}"
    slices = message.arrays()["slices"]
    carriers = np.array(message.header["carriers"])
    stem.with_suffix(".json").write_text(json.dumps(message.header, indent=2), encoding="utf-8")
    np.save(stem.with_suffix(".npy"), slices)
    Image.fromarray(slice_mosaic(slices, carriers)).save(stem.with_suffix(".png"))
