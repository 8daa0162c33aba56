"""Show text of others: names of files, values of logs, answers of servers may hold what a terminal would obey."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO, cast

_ALIKE = 8


def few(lines: Iterable[str]) -> Iterator[str]:
    """Of lines that say the same of one thing after another the first eight, and how many more there are.

    >>> list(few(f"frame {index} has no mark" for index in range(3000)))[-2:]
    ['frame 7 has no mark', '… and 2992 more']
    """
    more = 0
    for count, line in enumerate(lines):
        more = max(0, count - _ALIKE + 1)
        if not more:
            yield line
    if more:
        yield f"… and {more} more"


def printable(text: str) -> str:
    """A text on one line, with what a terminal would obey or can't show as escapes.

    >>> print(printable("notes\\r\\udcff.txt was added"))
    notes\\r\\udcff.txt was added
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def say(text: str, *, error: bool = False, end: str = "\n") -> None:
    """Print one line, on standard error where that is wished: nothing else in dappled prints, and no name begins a line
    of its own."""
    print(printable(text), end=end, file=sys.stderr if error else sys.stdout, flush=True)


class LineFormatter(logging.Formatter):
    """Formats a record as one line; a traceback follows it."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # logging's name
        return printable(super().formatMessage(record))


class ShownStream:
    """A text stream that writes lines as `printable` shows them; in everything else it is the one below."""

    def __init__(self, below: TextIO) -> None:
        self._below = below

    def write(self, text: str) -> int:
        """Write a text, whose line ends stay."""
        self._below.write(text if text.isprintable() else "\n".join(map(printable, text.split("\n"))))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._below, name)


def guard_output() -> None:
    """From now on all that this process prints or logs is shown so. A progress bar, which moves the cursor, writes to
    `sys.__stderr__`."""
    if logging.lastResort is not None:  # what logs in a process that sets no log up
        logging.lastResort.setFormatter(LineFormatter())
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, ShownStream):
            setattr(sys, name, cast("TextIO", ShownStream(stream)))
