"""What the person who started a daemon reads: a line a frame, what becomes of the camera, each problem once.

On a terminal these are lines; where the log goes to the journal, records with fields: `journalctl -u dappled
DAPPLED_FRAME=42`.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from dappled.daemon.health.log_format import JournalHandler
from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.drivers.camera import StateChanged
from dappled.workers import Worker

log = logging.getLogger("dappled.run")
_PROBLEMS_EVERY_S = 1.0
_NUMBER = re.compile(r"\d+")  # a problem whose numbers change is still the same


class Say(Protocol):
    """Says a line; `fields` are what a program would ask the journal for."""

    def __call__(self, text: str, level: int = ..., **fields: object) -> None: ...


def remark(text: str, level: int = logging.INFO, **fields: object) -> None:
    """A line beside the frames', on standard error or in the journal."""
    if _journalled():
        log.log(level, "%s", text, extra={"dappled": fields})
    else:
        print(text, file=sys.stderr)


@dataclass(frozen=True, slots=True)
class _Line:
    """The line of a frame, as it was when the frame's story ended."""

    text: str
    level: int
    fields: Mapping[str, object]


class Frames:
    """Prints a `line` for each frame on standard output, or in the journal unless `for_programs`. A terminal that
    stands still holds up nobody."""

    def __init__(self, line: Callable[[PendingShot], str], *, for_programs: bool = False) -> None:
        self._line, self._for_programs = line, for_programs
        self._lines: Worker[_Line] = Worker("print", self._print, capacity=1000, policy="drop oldest")
        self._lines.start()

    def finished(self, one: PendingShot) -> None:
        """A shot has come to its end."""
        fields = {"frame": one.shot.index, "state": "safe" if one.frame else "failed", "problem": one.problem}
        level = logging.WARNING if one.problem else logging.INFO
        self._lines.put(_Line(self._line(one), level, {name: value for name, value in fields.items() if value != ""}))

    def close(self) -> None:
        """Print what waits, for a second at most."""
        self._lines.stop(1.0)

    def _print(self, line: _Line) -> None:
        if _journalled() and not self._for_programs:
            remark(line.text, line.level, **line.fields)
            return
        try:
            print(line.text, flush=True)
        except OSError:  # nobody reads any more; the record is what counts
            sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for as long as we live


class CameraRemarks:
    """Says what becomes of the camera; that it is busy and is free again goes without saying."""

    def __init__(self, say: Say = remark) -> None:
        self.state = "starting"
        self._say = say

    def changed(self, change: StateChanged) -> None:
        """The camera is in another state."""
        if change.state in ("busy", self.state):
            return
        self.state = change.state
        level = logging.INFO if change.state in ("starting", "ready") else logging.WARNING
        self._say(
            f"camera {change.state}" + (f": {change.reason}" if change.reason else ""), level, camera=change.state
        )


class ProblemRemarks:
    """Says each problem once, when it comes up; `told` gets the whole of `health` each second."""

    def __init__(
        self,
        health: Callable[[], Mapping[str, Any]],
        told: Callable[[Mapping[str, Any]], None],
        *,
        say: Say = remark,
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
        problems = {_NUMBER.sub("#", text): text for text in record["problems"]}
        for kind, text in sorted(problems.items()):
            if kind not in self._said:
                self._say(f"problem: {text}", logging.WARNING, problem=text)
        self._said = set(problems)
        self._told(record)


def _journalled() -> bool:
    return any(isinstance(one, JournalHandler) for one in logging.getLogger().handlers)
