"""Watching a stream to its end: each frame counted once, however often it comes, and kept as files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image

from dappled.daemon.stream.wire import Message
from dappled.decode.lightfield.pictures import slice_mosaic

_LOOK_S = 0.5


class Stream(Protocol):
    """What is watched; a `Subscriber`."""

    @property
    def waiting_for(self) -> int:
        """How many answers are still to come."""

    def receive(self, timeout_s: float) -> Message | None:
        """The next message; None when there was none for that long."""


@dataclass(frozen=True, slots=True)
class Watched:
    """How many frames' slices came, and whether the flight ended meanwhile."""

    frames: int
    ended: bool

    def short_of(self, count: int | None) -> bool:
        """Whether frames are missing of those asked for; without a count, whether the flight broke off at nothing."""
        if count is None:
            return not self.ended and not self.frames
        return self.frames < count


def watch(
    stream: Stream,
    *,
    heard: Callable[[Message], None],
    new_frame: Callable[[Message], None],
    count: int | None = None,
    silence_s: float | None = None,
    clock_s: Callable[[], float] = time.monotonic,
) -> Watched:
    """Receive until `count` frames' slices have come, the flight has ended and nothing asked for is still to come, or
    nothing came for `silence_s`. `heard` gets every message, `new_frame` the first slices of each frame."""
    frames: set[tuple[str, int]] = set()
    ended = False
    last_s = clock_s()
    while not (ended and not stream.waiting_for) and (count is None or len(frames) < count):
        message = stream.receive(_LOOK_S)
        if message is None:
            if silence_s and clock_s() - last_s > silence_s:
                break
            continue
        last_s = clock_s()
        ended = ended or message.topic == "end"
        heard(message)
        if message.topic == "slices":
            frame = (message.header["flight"], message.header["frame"])
            if frame not in frames:
                frames.add(frame)
                new_frame(message)
    return Watched(len(frames), ended)


def keep(message: Message, folder: Path) -> None:
    """Header as JSON, slices as NPY, and the mosaic of the slices as PNG (Fig 43), named by the frame."""
    stem = folder / f"{message.header['frame']:06d}"
    slices = message.arrays()["slices"]
    carriers = np.array(message.header["carriers"])
    stem.with_suffix(".json").write_text(json.dumps(message.header, indent=2), encoding="utf-8")
    np.save(stem.with_suffix(".npy"), slices)
    Image.fromarray(slice_mosaic(slices, carriers)).save(stem.with_suffix(".png"))
