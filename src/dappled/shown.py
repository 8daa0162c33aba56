"""Show text of others: names of files, values of logs, answers of servers may hold what a terminal would obey."""

from __future__ import annotations

import sys
from typing import Any, TextIO, cast


def printable(text: str) -> str:
    """A text on one line, with what a terminal would obey or can't show as escapes.

    >>> print(printable("notes\\r\\udcff.txt was added"))
    notes\\r\\udcff.txt was added
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


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
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, ShownStream):
            setattr(sys, name, cast("TextIO", ShownStream(stream)))
