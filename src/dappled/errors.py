"""The errors that are reported to a person in one sentence (what, where, what to do), and words for numbers."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import ClassVar

from dappled.findings import FRAME, Finding, told

SERVICE_MANIFEST = "installed.json"  # which `make install` leaves in its environment
PACKAGED = "packaged"  # which the Debian package has beside dappled's own folder


class DappledError(Exception):
    """Something a person can mend. The message is the whole sentence, or the finding that tells it (`finding`); no
    traceback is shown with it.

    `exit_code` is what a command ends with: 1 for a failure, 2 where the call itself was wrong. `setting` is the one
    that is wrong, as "table.key", where the code that found it knows.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, *text: object, setting: str = "") -> None:
        self.finding = next((one for one in text if isinstance(one, Finding)), None)
        super().__init__(*(str(told(one, FRAME)) if isinstance(one, Finding) else one for one in text))
        self.setting = setting

    @property
    def sentences(self) -> list[str]:
        """The message; a kind of error that gathers several things gives a sentence for each."""
        return [str(self)]


class CallError(DappledError):
    """The call itself is wrong: what it names, or asks for, can't be; one sentence."""

    exit_code = 2


def sentence(error: BaseException) -> str:
    """An error as a sentence: its own, or its kind where it was not meant for a person."""
    return str(error) if isinstance(error, DappledError) else f"unexpected {type(error).__name__}: {error}"


def first_line(error: BaseException) -> str:
    """What a library says of an error, on one line of at most 200 characters; its kind where it says nothing."""
    said = error.args[0] if error.args else ""
    text = (said.decode("ascii", "replace") if isinstance(said, bytes) else str(error)).strip()
    line = text.splitlines()[0] if text else type(error).__name__
    return line if len(line) <= 200 else f"{line[:199]}…"


def counted(count: int, noun: str, width: int = 0) -> str:
    """A number with its noun: 1 frame, 2 frames."""
    return f"{count:{width}d} {noun}" + ("" if count == 1 else "s")


def report(log: logging.Logger, what: str, error: BaseException) -> None:
    """Log an error as one sentence; the traceback of an unexpected one only in the log's details."""
    details = not isinstance(error, DappledError) and log.isEnabledFor(logging.DEBUG)
    log.warning("%s: %s", what, sentence(error), exc_info=error if details else None)


def install_extra(extra: str) -> str:
    """How a person gets what an extra brings. The service's own environment can't be added to."""
    wanted = f"pip install 'dappled[{extra}]'"
    if (Path(sys.prefix) / SERVICE_MANIFEST).exists() or (Path(__file__).parents[1] / PACKAGED).exists():
        return f"the onboard installation leaves it out; on the ground, in an environment of its own: {wanted}"
    return f"install it with: {wanted}"
