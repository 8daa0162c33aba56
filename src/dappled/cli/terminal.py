"""What the person who started a daemon reads: a line a frame, what becomes of the camera, each problem once."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from dappled.daemon.stages import Stage
from dappled.daemon.story import Story
from dappled.drivers.camera import StateChanged

_PROBLEMS_EVERY_S = 1.0


def remark(text: str) -> None:
    """A line beside the frames', on standard error."""
    print(text, file=sys.stderr)


class Frames:
    """Prints a `line` for each frame on standard output. A terminal that stands still holds up nobody."""

    def __init__(self, line: Callable[[Story], str]) -> None:
        self._line = line
        self._lines: Stage[str] = Stage("print", _print, capacity=1000, policy="drop oldest")
        self._lines.start()

    def finished(self, one: Story) -> None:
        """A shot has come to its end."""
        self._lines.put(self._line(one))

    def close(self) -> None:
        """Print what waits, for a second at most."""
        self._lines.stop(1.0)


class CameraRemarks:
    """Says what becomes of the camera; that it is busy and is free again goes without saying."""

    def __init__(self, say: Callable[[str], None] = remark) -> None:
        self.state = "starting"
        self._say = say

    def changed(self, change: StateChanged) -> None:
        """The camera is in another state."""
        if change.state in ("busy", self.state):
            return
        self.state = change.state
        self._say(f"camera {change.state}" + (f": {change.reason}" if change.reason else ""))


class ProblemRemarks:
    """Says each problem once, when it comes up; `told` gets the whole of `health` each second."""

    def __init__(
        self,
        health: Callable[[], Mapping[str, Any]],
        told: Callable[[Mapping[str, Any]], None],
        *,
        say: Callable[[str], None] = remark,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._health, self._told, self._say, self._clock_s = health, told, say, clock_s
        self._said: set[str] = set()
        self._due_s = clock_s() + _PROBLEMS_EVERY_S

    def tell(self, *, now: bool = False) -> None:
        """Look whether there is something to say, if it is time to, or at once."""
        if not now and self._clock_s() < self._due_s:
            return
        self._due_s = self._clock_s() + _PROBLEMS_EVERY_S
        record = self._health()
        problems = set(record["problems"])
        for text in sorted(problems - self._said):
            self._say(f"problem: {text}")
        self._said = problems
        self._told(record)


def _print(line: str) -> None:
    try:
        print(line, flush=True)
    except OSError:  # nobody reads any more; the record is what counts
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for as long as we live
