"""Keep a process of the daemon's own running, and exchange messages with it: the console, the listener for viewers."""

from __future__ import annotations

import logging
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from dappled.clock import Clock
from dappled.drivers.child_process import (
    VIEWERS_GO,
    ChannelError,
    ChannelMessage,
    ProcessChannel,
    RestartBudget,
    end_child,
    start_child,
)
from dappled.errors import report
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)
_TURN_S = 0.2


@dataclass(frozen=True, slots=True)
class ChildProgram:
    """A module that is run as a process, see `start_child`. `title` is what the log calls it.

    It inherits `descriptors`, and `environment` in addition to the daemon's own. It ends by itself when its channel is
    closed, and is killed `end_s` later.
    """

    title: str
    module: str
    arguments: tuple[str, ...] = ()
    descriptors: tuple[int, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    end_s: float = 2.0


class ProcessPeer(Protocol):
    """The daemon's side of a supervised process. An exception ends the process, which is then started again."""

    def begun(self, channel: ProcessChannel) -> None:
        """The process was started, the first time or again."""

    def turn(self, channel: ProcessChannel, message: ChannelMessage | None) -> None:
        """Its next message; None where none came for 0.2 s."""


class SupervisedProcess(OneThread):
    """Keeps a process running: when it ends it is started again, at most five times a minute."""

    def __init__(
        self, name: str, program: ChildProgram, peer: ProcessPeer, clock: Clock, budget: RestartBudget | None = None
    ) -> None:
        """`name` is the thread's."""
        self._program, self._peer, self._clock = program, peer, clock
        self._budget = budget or RestartBudget(limit=5, window_s=60.0)
        self.process: subprocess.Popen[bytes] | None = None
        self._loop = Loop(name, self._run)

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the process, and wait so long for the thread."""
        self._loop.stop(timeout_s)

    def _run(self) -> None:
        stopping, title = self._loop.stopping, self._program.title
        while not stopping.is_set():
            if wait_ns := self._budget.wait_ns(self._clock.monotonic_ns()):
                log.warning("%s ended too often; the next attempt is in %.0f s", title, wait_ns / 1e9)
                self._clock.wait(stopping, wait_ns / 1e9)
                continue
            self._budget.spend(self._clock.monotonic_ns())
            try:
                self._keep_one()
            except ChannelError as error:
                if not stopping.is_set():
                    log.warning("%s ended: %s", title, error)
            except Exception as error:  # noqa: BLE001  # it is started again in any case, at most five times a minute
                report(log, title, error)

    def _keep_one(self) -> None:
        """Start the process and serve it until it ends or must. Raises ChannelError, and what the peer raises."""
        one = self._program
        self.process, channel = start_child(
            one.module,
            *one.arguments,
            descriptors=one.descriptors,
            environment=one.environment,
            goes_first=VIEWERS_GO,
        )
        try:
            self._peer.begun(channel)
            while not self._loop.stopping.is_set():
                self._peer.turn(channel, channel.receive(_TURN_S))
        finally:
            channel.close()  # this ends the process
            process, self.process = self.process, None
            end_child(process, one.end_s)
