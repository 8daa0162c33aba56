"""Run the console in a process of its own, and answer what it asks of the daemon."""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from dappled import codec, key_files
from dappled.clock import Clock
from dappled.config import settings as configuration
from dappled.config.settings import ConsoleSettings, Settings
from dappled.daemon.console.requests import ConsoleRequests
from dappled.daemon.stream.sockets import is_loopback
from dappled.daemon.supervised_process import ChildProgram, SupervisedProcess
from dappled.drivers.child_process import ChannelError, ChannelMessage, ProcessChannel, RestartBudget
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError

_BACKLOG = 32
_TOKEN_CHARACTERS = 12
_ANSWER_S = 3.0


class ConsoleRequestError(DappledError):
    """The daemon did not answer the console; one sentence."""


def credentials(settings: ConsoleSettings) -> tuple[str, int, str]:
    """Host and port of `console.bind`, and the token ("" on loopback without one). Nothing is opened but its file.

    Raises DappledError, or DappledError for a token file that others can read.
    """
    host, port = address(settings.bind)
    token = key_files.read(Path(settings.token), "the console's token").strip() if settings.token else ""
    if settings.token and len(token) < _TOKEN_CHARACTERS:
        raise DappledError(
            f"{settings.token} holds no token of {_TOKEN_CHARACTERS} characters: make one with `dappled keys token`"
        )
    if not token and not is_loopback(host):
        raise DappledError(
            f"console.bind = {settings.bind!r} would be open to the network without a token: make one with "
            "`dappled keys token FILE`, and name it in console.token"
        )
    return host, port, token


def listen(settings: ConsoleSettings) -> tuple[socket.socket, str]:
    """The listening socket of `console.bind`, and the token. Raises like `credentials`."""
    host, port, token = credentials(settings)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    one = socket.socket(family, socket.SOCK_STREAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        one.bind((host, port))
        one.listen(_BACKLOG)
    except OSError as error:
        one.close()
        raise DappledError(
            f"the console can't listen on {settings.bind}: {error.strerror}; choose another console.bind"
        ) from None
    return one, token


def address(bind: str) -> tuple[str, int]:
    """(host, port) of "host:port" or "[host]:port". Raises DappledError."""
    host, colon, port = bind.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535 or not host:
        raise DappledError(f"console.bind = {bind!r} must be host:port, such as 127.0.0.1:8080")
    return host.strip("[]"), int(port)


def url(listener: socket.socket) -> str:
    """The address for a browser on this machine."""
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104  # compared with
    return f"http://{host}:{port}/"


class Console(SupervisedProcess):
    """Keeps the console's process running, and answers its requests by `handler`.

    The process has a low priority. When it ends it is started again; the listening socket stays open meanwhile, so that
    browsers wait instead of failing.
    """

    def __init__(
        self,
        listener: socket.socket,
        setup: Mapping[str, Any],
        handler: ConsoleRequests,
        clock: Clock,
        budget: RestartBudget | None = None,
    ) -> None:
        self._listener = listener
        program = ChildProgram(
            "the console's process",
            "dappled.daemon.console",
            (str(listener.fileno()),),
            (listener.fileno(),),
            # One thread for its arithmetic: the other cores are for the flight.
            {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        super().__init__("console", program, _PageRequests(setup, handler), clock, budget)

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the process, and close the listening socket."""
        super().stop(timeout_s)
        self._listener.close()


@dataclass(frozen=True, slots=True)
class _PageRequests:
    """The daemon's side of the console: sends `setup`, and answers its requests one by one."""

    setup: Mapping[str, Any]
    handler: ConsoleRequests

    def begun(self, channel: ProcessChannel) -> None:
        channel.send(self.setup, timeout_s=5.0)

    def turn(self, channel: ProcessChannel, message: ChannelMessage | None) -> None:
        if message is None:
            return
        answer = {**self.handler.answer(message.body), "number": message.body.get("number")}
        picture = answer.pop("picture", None)
        if picture is None:
            channel.send(answer)
            return
        with os.fdopen(os.memfd_create("picture", os.MFD_CLOEXEC), "wb") as file:  # too long for a message
            file.write(picture)
            file.flush()
            channel.send({**answer, "size": len(picture)}, (file.fileno(),))


@dataclass(frozen=True, slots=True)
class ConsoleListener:
    """A console's listening socket, its token, and the endpoint that it subscribes to."""

    listener: socket.socket
    token: str
    private: str  # a further ipc endpoint of the publisher; "" where the stream itself is ipc

    @property
    def url(self) -> str:
        """The address for a browser on this machine."""
        return url(self.listener)


def open_listener(settings: Settings, stack: ExitStack) -> ConsoleListener | None:
    """Open the configured console's socket; None without a console. The stack closes it. Raises like `listen`."""
    if not settings.console.bind:
        return None
    listener, token = listen(settings.console)
    stack.callback(listener.close)
    ipc = settings.publish.slices.startswith("ipc://")
    return ConsoleListener(listener, token, "" if ipc else f"ipc://{configuration.runtime_folder()}/own-{os.getpid()}")


def start(
    opened: ConsoleListener,
    settings: Settings,
    stack: ExitStack,
    *,
    recipe: Recipe | None,
    requests: ConsoleRequests,
    clock: Clock,
) -> Console:
    """Start the console; the stack ends it. `recipe` is how frames are decoded."""
    publish = settings.publish
    setup = {
        "token": opened.token,
        "hosts": list(settings.console.hosts),
        "map": settings.console.map,
        "area": settings.console.area,
        "endpoint": opened.private or publish.slices,
        "ask": f"{opened.private}.ask" if opened.private else publish.ask,
        "recipe": codec.plain(recipe),
        "mount": list(settings.pose.mount),
        "run": requests.run,
    }
    logger = logging.getLogger("dappled")
    logger.addHandler(requests.logbook)
    stack.callback(logger.removeHandler, requests.logbook)
    console = Console(opened.listener, setup, requests, clock)
    console.start()
    stack.callback(console.stop)
    return console


class DaemonQuestions(Protocol):
    """Answers the page's questions: `DaemonChannel`, or what stands for a daemon where there is none."""

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """The answer. Raises ConsoleRequestError."""


class DaemonChannel:
    """The console process' end: asks the daemon, from any thread, one question at a time."""

    def __init__(self, channel: ProcessChannel) -> None:
        self._channel = channel
        self._turn = threading.Lock()
        self._number = 0
        self.gone = threading.Event()

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """The daemon's answer. Raises ConsoleRequestError; `gone` is set when the daemon has ended."""
        with self._turn:
            self._number += 1
            try:
                self._channel.send({**question, "number": self._number}, timeout_s=1.0)
                while (answer := self._channel.receive(_ANSWER_S)) is not None:
                    told = dict(answer.body)
                    for fd in answer.fds:
                        told["picture"] = os.pread(fd, told["size"], 0)
                        os.close(fd)
                    if told.get("number") == self._number:
                        return told
            except ChannelError:
                self.gone.set()
                raise ConsoleRequestError("the daemon has ended") from None
        raise ConsoleRequestError("the daemon did not answer: check whether the shot was taken before you ask again")
