"""The daemon's side of the console: its door, its process, and the few things that it may ask of the daemon."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dappled.config import settings as configuration
from dappled.config.settings import ConsoleSettings, Settings
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.stream.curve import read_private
from dappled.daemon.stream.sockets import is_loopback
from dappled.drivers.process_channel import ChannelError, ProcessChannel
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import DappledError, report

log = logging.getLogger(__name__)
RESTARTS, RESTART_WINDOW_S = 5, 60.0
_BACKLOG = 32
_TOKEN_CHARACTERS = 12

Act = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class ConsoleError(DappledError):
    """The console can't be opened; one sentence."""


def listen(settings: ConsoleSettings) -> tuple[socket.socket, str]:
    """The listening socket of `console.bind`, and the token ("" on loopback without one).

    Raises ConsoleError, or KeyFileError for a token file that others can read.
    """
    host, port = address(settings.bind)
    token = read_private(Path(settings.token), "the console's token").strip() if settings.token else ""
    if settings.token and len(token) < _TOKEN_CHARACTERS:
        raise ConsoleError(f"{settings.token} holds no token of {_TOKEN_CHARACTERS} characters: dappled keys token")
    if not token and not is_loopback(host):
        raise ConsoleError(
            f"console.bind = {settings.bind!r} would be open to the network without a token: make one with "
            "`dappled keys token FILE`, and name it in console.token"
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    one = socket.socket(family, socket.SOCK_STREAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        one.bind((host, port))
        one.listen(_BACKLOG)
    except OSError as error:
        one.close()
        raise ConsoleError(
            f"the console can't listen on {settings.bind}: {error.strerror}; choose another console.bind"
        ) from None
    return one, token


def address(bind: str) -> tuple[str, int]:
    """(host, port) of "host:port" or "[host]:port". Raises ConsoleError."""
    host, colon, port = bind.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535 or not host:
        raise ConsoleError(f"console.bind = {bind!r} must be host:port, such as 127.0.0.1:8080")
    return host.strip("[]"), int(port)


def url(listener: socket.socket) -> str:
    """Where a browser on this machine finds it."""
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104  # compared with
    return f"http://{host}:{port}/"


class Console:
    """Keeps the console's process running, and does what it asks: `act` gets a request and gives the answer.

    It runs at low priority. One that ends is started again, at most five times a minute; the socket stays open
    meanwhile, so that browsers wait instead of failing.
    """

    def __init__(self, listener: socket.socket, setup: Mapping[str, Any], act: Act) -> None:
        self._listener, self._setup, self._act = listener, setup, act
        self._stopping = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._begun: deque[float] = deque(maxlen=RESTARTS)
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)
        self.problem = ""

    def start(self) -> None:
        """Start the process."""
        self._thread.start()

    def stop(self) -> None:
        """End it, and close the door."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(5)
        self._listener.close()

    def _run(self) -> None:
        while not self._stopping.is_set():
            if len(self._begun) == RESTARTS and time.monotonic() - self._begun[0] < RESTART_WINDOW_S:
                self.problem = "the console's process ended five times in a minute: it rests for one"
                log.warning("%s", self.problem)
                self._stopping.wait(RESTART_WINDOW_S)
                self._begun.clear()
                continue
            self.problem = ""
            self._begun.append(time.monotonic())
            try:
                self._serve()
            except Exception as error:  # noqa: BLE001  # whatever it was, it is started again, within the budget
                report(log, "the console ended", error)

    def _serve(self) -> None:
        channel, there = ProcessChannel.pair()
        with there:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "dappled.daemon.console", str(there.fileno()), str(self._listener.fileno())],
                pass_fds=[there.fileno(), self._listener.fileno()],
                stdin=subprocess.DEVNULL,
                # One thread for its arithmetic: the other cores are the flight's.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
        try:
            channel.send(self._setup, timeout_s=5.0)
            while not self._stopping.is_set():
                question = channel.receive(0.2)
                if question is not None:
                    channel.send({**self._act(question.body), "number": question.body.get("number")})
        except ChannelError as error:
            if not self._stopping.is_set():
                log.warning("the console ended: %s", error)
        finally:
            channel.close()  # which ends it
            self._reap()

    def _reap(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for end in (None, process.terminate, process.kill):
            if end is not None:
                end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
                return


@dataclass(frozen=True, slots=True)
class Door:
    """What a console needs from the start: its listening socket, its token, and where it may subscribe."""

    listener: socket.socket
    token: str
    private: str  # an endpoint of the daemon's own; "" where the stream itself is ipc

    @property
    def url(self) -> str:
        """Where a browser on this machine finds it."""
        return url(self.listener)


def open_door(settings: Settings, stack: ExitStack) -> Door | None:
    """The door of the configured console, None without one; closed with the stack. Raises as `listen`."""
    if not settings.console.bind:
        return None
    listener, token = listen(settings.console)
    stack.callback(listener.close)
    ipc = settings.publish.slices.startswith("ipc://")
    return Door(listener, token, "" if ipc else f"ipc://{configuration.runtime_folder()}/own-{os.getpid()}")


def begin(
    door: Door, settings: Settings, stack: ExitStack, *, recipe: Recipe | None, act: Act, logbook: Logbook
) -> None:
    """Start the console; it ends with the stack. `recipe` is what frames are decoded with."""
    publish = settings.publish
    setup = {
        "token": door.token,
        "hosts": list(settings.console.hosts),
        "map": settings.console.map,
        "endpoint": door.private or publish.slices,
        "ask": f"{door.private}.ask" if door.private else publish.ask,
        "recipe": None if recipe is None else asdict(recipe),
        "mount": list(settings.pose.mount),
    }
    logger = logging.getLogger("dappled")
    logger.addHandler(logbook)
    stack.callback(logger.removeHandler, logbook)
    console = Console(door.listener, setup, act)
    console.start()
    stack.callback(console.stop)
