"""Bars on a terminal: drawn while work goes on, with an estimate once a part of it is done, taken off at its end."""

from __future__ import annotations

import os
import pty
import re
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dappled.cli import rendering
from dappled.cli.rendering import TerminalOutput


class Terminal:
    """The screen's side of a terminal that standard error is."""

    def __init__(self, screen: int) -> None:
        self._screen = screen
        self.text = ""

    def until(self, pattern: str) -> re.Match[str]:
        """Read until what was written has the pattern."""
        while (found := re.search(pattern, self.text)) is None:
            self.text += os.read(self._screen, 4096).decode()
        self.text = self.text[found.end() :]
        return found


@contextmanager
def shown(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """Within: pytest puts its own standard error back between a fixture and a test."""
    screen, end = pty.openpty()
    termios.tcsetwinsize(end, (25, 100))
    with (
        os.fdopen(end, "w", buffering=1) as stream,
        os.fdopen(screen, "rb", buffering=0),
        monkeypatch.context() as patch,
    ):
        patch.setattr(sys, "stderr", stream)
        patch.setattr(sys, "__stderr__", stream)
        patch.setattr(rendering, "_AFTER_S", 0.05)
        yield Terminal(screen)


def test_a_bar_is_drawn_before_the_first_frame_is_done_and_tells_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    with shown(monkeypatch) as terminal:
        stretches(terminal)


def stretches(terminal: Terminal) -> None:
    output = TerminalOutput("georeference", as_json=False)
    output.show("develop", 0, 8)
    terminal.until(r"develop: +0%.* 0/8 \[")
    output.show("develop", 1, 8)
    left = terminal.until(r"develop: +12%.* 1/8 \[\d\d:\d\d<(\S+),")
    assert left[1] != "?"
    output.show("draw maps", 0, 3)  # the next stretch begins
    terminal.until(r"\r +\r")
    terminal.until(r"draw maps: +0%.* 0/3 \[")
    output.close()
    terminal.until(r"\r +\r")
    output.remark("done")
    assert terminal.until(r".*done\r?\n")[0].strip() == "done"


def test_a_line_is_printed_beside_a_bar_that_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    output = TerminalOutput("decode", as_json=False)
    with shown(monkeypatch) as terminal:
        with output.bar(2, "frame") as add:
            terminal.until(r" 0/2 \[")
            output.remark("frame 1: hazy")
            terminal.until(r"frame 1: hazy\r?\n")
            add(1)
            terminal.until(r" 1/2 \[\d\d:\d\d<")
        terminal.until(r"\r +\r")
