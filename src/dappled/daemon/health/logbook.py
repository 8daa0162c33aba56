"""The last lines of the log, and the sentences in it."""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal

from dappled import codec
from dappled.clock import Clock
from dappled.daemon.pipeline.capture import PendingShot
from dappled.errors import sentence
from dappled.findings import text

LineLevel = Literal["info", "warning"]


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line; numbers count from 1 without gaps."""

    number: int
    utc_ns: int
    level: LineLevel
    text: str


class Logbook(logging.Handler):
    """Keeps the last lines, for the console; as a handler of a logger also its warnings."""

    def __init__(self, clock: Clock, *, capacity: int = 200) -> None:
        super().__init__(logging.WARNING)
        self._clock = clock
        self._lines: deque[LogLine] = deque(maxlen=capacity)
        self._guard = threading.Lock()
        self._count = 0

    def add(self, text: str, level: LineLevel = "info") -> None:
        """Add a line; the oldest is removed when the logbook is full. The same line twice in a row is kept once."""
        with self._guard:
            if self._lines and self._lines[-1].text == text:
                return
            self._count += 1
            self._lines.append(LogLine(self._count, self._clock.utc_ns(), level, text))

    def after(self, number: int, limit: int = 50) -> list[dict[str, Any]]:
        """The newest lines with a higher number, oldest first, as JSON values; at most `limit`."""
        with self._guard:
            return [codec.plain(line) for line in self._lines if line.number > number][-limit:]

    def emit(self, record: logging.LogRecord) -> None:
        """Add a logger's warning."""
        try:
            text = record.getMessage()
        except (TypeError, ValueError) as error:  # the message's arguments don't fit it
            text = sentence(error)
        self.add(text, "warning")


def of_shot(pending: PendingShot) -> tuple[str, LineLevel]:
    """The line that says how a shot ended, and its level."""
    who = f"frame {pending.shot.index}" if pending.frame else f"shot {pending.shot.index}"
    if pending.problem:
        return f"{who}: {text(pending.problem)}", "warning"
    if pending.frame is None and pending.follows:
        return f"{who}: {text(pending.follows)}", "info"
    words = [f"{who} is safe"]
    if pending.frame:
        words[0] += f", {pending.frame.size / 1e6:.1f} MB"
    if pending.decoded:
        done = pending.decoded
        found = "no" if done.carriers_found is None else f"{done.carriers_found} of {done.carriers_predicted}"
        where = ", not observable at this aperture" if done.carriers_found is None else ""
        words.append(f"{found} carriers ({done.carriers_from}{where})")
        words.append(f"decoded in {pending.ms.get('decode', 0.0) / 1e3:.1f} s")
    return "; ".join(words), "info"
