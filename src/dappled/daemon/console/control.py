"""What the console asks of the daemon, over the socket between the two: one question, one answer, soon or never."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from dappled.drivers.process_channel import ChannelError, ProcessChannel
from dappled.errors import DappledError

_ANSWER_S = 3.0


class ControlError(DappledError):
    """The daemon did not answer; one sentence."""


class Control:
    """Questions from any thread, one after the other."""

    def __init__(self, channel: ProcessChannel) -> None:
        self._channel = channel
        self._turn = threading.Lock()
        self._number = 0
        self.gone = threading.Event()

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """The daemon's answer. Raises ControlError; when the daemon is gone, `gone` is set."""
        with self._turn:
            self._number += 1
            try:
                self._channel.send({**question, "number": self._number}, timeout_s=1.0)
                while (answer := self._channel.receive(_ANSWER_S)) is not None:
                    if answer.body.get("number") == self._number:
                        return dict(answer.body)
            except ChannelError:
                self.gone.set()
                raise ControlError("the daemon is gone") from None
        raise ControlError("the daemon did not answer: look whether the shot was taken before you ask again")
