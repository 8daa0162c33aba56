"""The log's last lines in words, for whoever looks at the daemon from outside its terminal."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.errors import sentence

Level = Literal["info", "warning"]


@dataclass(frozen=True, slots=True)
class Line:
    """One line; numbers count from 1 without gaps."""

    number: int
    utc_ns: int
    level: Level
    text: str


class Logbook(logging.Handler):
    """Keeps the last lines; also what this package's loggers warn of, while it hangs there as a handler."""

    def __init__(self, utc_ns: Callable[[], int], *, capacity: int = 200) -> None:
        super().__init__(logging.WARNING)
        self._utc_ns = utc_ns
        self._lines: deque[Line] = deque(maxlen=capacity)
        self._guard = threading.Lock()
        self._count = 0

    def add(self, text: str, level: Level = "info") -> None:
        """One line more; the oldest goes where there is no room. A line said twice in a row stands once."""
        with self._guard:
            if self._lines and self._lines[-1].text == text:
                return
            self._count += 1
            self._lines.append(Line(self._count, self._utc_ns(), level, text))

    def after(self, number: int, limit: int = 50) -> list[dict[str, Any]]:
        """The newest lines with a higher number, oldest first, as JSON values; at most `limit`."""
        with self._guard:
            return [asdict(line) for line in self._lines if line.number > number][-limit:]

    def emit(self, record: logging.LogRecord) -> None:
        """A warning of a logger."""
        try:
            text = record.getMessage()
        except (TypeError, ValueError) as error:  # a message whose arguments don't fit it
            text = sentence(error)
        self.add(text, "warning")


def of_story(pending: PendingShot) -> tuple[str, Level]:
    """What became of a shot, in words."""
    who = f"frame {pending.shot.index}" if pending.frame else f"shot {pending.shot.index}"
    if pending.problem:
        return f"{who}: {pending.problem}", "warning"
    if pending.frame is None and pending.follows:
        return f"{who}: {pending.follows}", "info"
    words = [f"{who} is safe"]
    if pending.frame:
        words[0] += f", {pending.frame.size / 1e6:.1f} MB"
    if pending.decoded:
        done = pending.decoded
        words.append(f"{done.carriers_found} of {done.carriers_predicted} carriers ({done.carriers_from})")
        words.append(f"decoded in {pending.ms.get('decode', 0.0) / 1e3:.1f} s")
    return "; ".join(words), "info"
