"""Watching a stream, with a scripted one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from PIL import Image

from dappled.clock import RecordedClock
from dappled.daemon.stream import watch, wire
from dappled.daemon.stream.subscriber import Subscriber
from dappled.daemon.stream.watch import Watched
from dappled.daemon.stream.wire import Message

STACK = np.arange(2 * 3 * 4, dtype=np.complex64).reshape(2, 3, 4)


def slices(frame: int, flight: str = "one") -> Message:
    header = {
        "flight": flight,
        "frame": frame,
        "carriers": [[0, 0, 0.0, 0.0], [0, 1, 0.0, 0.2]],
        "arrays": [wire.describe_array("slices", STACK, "1")],
    }
    return Message("slices", header, STACK.tobytes())


END = Message("end", {"flight": "one"})


class Script:
    """A stream that brings these messages, None for silence; `owed` answers are still to come."""

    def __init__(self, messages: Sequence[Message | None], owed: int = 0) -> None:
        self._messages = list(messages)
        self.waiting_for = owed
        self.clock = RecordedClock(0)

    def receive(self, timeout_s: float) -> Message | None:
        self.clock.advance(timeout_s)
        assert self._messages, "it should have ended"
        message = self._messages.pop(0)
        if message is not None and message.header.get("asked"):
            self.waiting_for -= 1
        return message

    @property
    def left(self) -> int:
        return len(self._messages)


def watched(script: Script, **options: float) -> tuple[Watched, list[str], list[int]]:
    heard: list[str] = []
    new: list[int] = []
    seen = watch.watch(
        cast(Subscriber, script),
        received=lambda message: heard.append(message.topic),
        new_frame=lambda message: new.append(message.header["frame"]),
        clock=script.clock,
        **options,  # type: ignore[arg-type]  # count is whole
    )
    return seen, heard, new


def test_a_frame_that_comes_twice_is_one() -> None:
    seen, heard, new = watched(Script([slices(1), slices(1), slices(1, "two"), slices(2), END]))
    assert (seen.frames, seen.ended) == (3, True)
    assert heard == ["slices"] * 4 + ["end"]
    assert new == [1, 1, 2]
    assert not seen.short_of(None)


def test_it_ends_with_the_count() -> None:
    script = Script([slices(1), slices(2), slices(3)])
    seen, _, new = watched(script, count=2)
    assert (new, script.left) == ([1, 2], 1)
    assert not seen.short_of(2)
    assert seen.short_of(3)


def test_after_the_end_it_waits_for_what_was_asked() -> None:
    answer = slices(7)
    asked = Message("slices", {**answer.header, "asked": {"get": "slices"}}, answer.body)
    seen, _, new = watched(Script([END, None, asked, slices(8)], owed=1))
    assert new == [7]
    assert (seen.frames, seen.ended) == (1, True)


@pytest.mark.parametrize("first", [[], [slices(1)]])
def test_silence_ends_it_where_that_is_wished(first: list[Message]) -> None:
    seen, _, _ = watched(Script([*first, *[None] * 5, slices(9)]), silence_s=2.0)
    assert seen == Watched(len(first), len(first), ended=False)
    assert seen.short_of(None) is not bool(first)


def test_a_frame_is_kept_as_header_slices_and_picture(tmp_path: Path) -> None:
    watch.save(slices(42), tmp_path)
    np.testing.assert_array_equal(np.load(tmp_path / "000042.npy"), STACK)
    assert json.loads((tmp_path / "000042.json").read_text())["frame"] == 42
    with Image.open(tmp_path / "000042.png") as picture:
        assert picture.size == (3 * (4 + 2), 3 + 2)  # the conjugate slice is filled in
