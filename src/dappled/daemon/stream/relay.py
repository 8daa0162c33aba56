"""Listen on TCP for viewers, in a process of its own: their connections take no file descriptors of the daemon's.

ZeroMQ accepts connections for as long as its process has descriptors, and the daemon photographs with the same ones. So
the daemon binds ipc endpoints only. For a tcp endpoint it binds one of its own, with CURVE where there are keys, and
the process relays to it what passes the limits of `admission`. The listening sockets stay open here, so that viewers
wait while that process is started again.
"""

from __future__ import annotations

import errno
import os
import secrets
import socket
import urllib.parse
from dataclasses import dataclass

from dappled.clock import Clock
from dappled.config import settings as configuration
from dappled.daemon.stream.wire import WireError
from dappled.daemon.supervised_process import ChildProgram, SupervisedProcess
from dappled.drivers.child_process import ChannelMessage, ProcessChannel
from dappled.findings import Code, Subject, finding
from dappled.refusals import RefusalLog

_BACKLOG = 128
_END_S = 3.0  # the process itself waits 2 s for viewers to read what it has
_STOP_S = 6.0


class TcpRelay:
    """Keeps the relaying process running where there is a tcp endpoint. Whom it refused is written to `refusals`."""

    def __init__(self, refusals: RefusalLog, clock: Clock) -> None:
        self._refusals, self._clock = refusals, clock
        self._routes: dict[str, socket.socket] = {}  # by path
        self._process: SupervisedProcess | None = None

    def listen(self, endpoint: str) -> str:
        """Listen on a tcp endpoint; returns the ipc endpoint to bind in its place. Raises WireError."""
        listener = _listener(endpoint)
        path = configuration.runtime_folder() / f"tcp-{os.getpid()}-{secrets.token_hex(4)}"
        self._routes[str(path)] = listener
        return f"ipc://{path}"

    def start(self) -> None:
        """Start the process, if there is anything to listen on."""
        if not self._routes:
            return
        program = ChildProgram(
            "the process for TCP viewers",
            "dappled.daemon.stream.relay_process",
            tuple(str(part) for path, listener in self._routes.items() for part in (listener.fileno(), path)),
            tuple(listener.fileno() for listener in self._routes.values()),
            end_s=_END_S,
        )
        self._process = SupervisedProcess("relay", program, _RefusalReports(self._refusals), self._clock)
        self._process.start()

    def stop(self) -> None:
        """End the process when viewers have read what it has, in two seconds at most, and close the sockets."""
        if self._process is not None:
            self._process.stop(_STOP_S)
        for listener in self._routes.values():
            listener.close()

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        return [] if self._process is None else self._process.dead_threads()


@dataclass(frozen=True, slots=True)
class _RefusalReports:
    """The daemon's side: writes down whom the process has refused."""

    refusals: RefusalLog

    def begun(self, channel: ProcessChannel) -> None:
        """The process was started, the first time or again. The process has all that it needs."""

    def turn(self, channel: ProcessChannel, message: ChannelMessage | None) -> None:
        self.refusals.settle()
        for address, reason, count in message.body.get("refused", ()) if message is not None else ():
            self.refusals.refused(finding(Code(reason), Subject("peer", str(address))), int(count))


def tcp_address(endpoint: str) -> tuple[str, int]:
    """(host, port) of tcp://HOST:PORT. Raises WireError."""
    try:
        url = urllib.parse.urlsplit(endpoint)
        host, port = url.hostname or "", url.port or 0
    except ValueError:
        host, port = "", 0
    if not host or not port:
        raise WireError(f"{endpoint} must be tcp://HOST:PORT, such as tcp://127.0.0.1:5555")
    return host, port


def _listener(endpoint: str) -> socket.socket:
    """A listening socket for tcp://HOST:PORT; * is every address. Raises WireError."""
    host, port = tcp_address(endpoint)
    host = "0.0.0.0" if host == "*" else host  # noqa: S104  # `prepare` asks for keys
    one = None
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        one = socket.socket(family, kind, protocol)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(address)
        one.listen(_BACKLOG)
    except OSError as error:
        if one is not None:
            one.close()
        if error.errno == errno.EADDRINUSE:
            raise WireError(f"{endpoint} is in use by another program; stop it, or choose another endpoint") from None
        raise WireError(f"{endpoint} can't be bound ({error.strerror}); choose another endpoint") from None
    return one
