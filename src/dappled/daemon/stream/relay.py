"""Listen on TCP for viewers, in a process of its own: their connections take no file descriptors of the daemon's.

ZeroMQ accepts connections for as long as its process has descriptors, and the daemon photographs with the same ones. So
the daemon binds ipc endpoints only. For a tcp endpoint it binds one of its own, with CURVE where there are keys, and
the process relays to it what passes the limits of `admission`. The listening sockets stay open here, so that viewers
wait while that process is started again.
"""

from __future__ import annotations

import errno
import logging
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.parse

from dappled.config import settings as configuration
from dappled.daemon.stream.wire import WireError
from dappled.drivers.child_process import ChannelError, ProcessChannel, RestartBudget, end_child
from dappled.errors import report
from dappled.refusals import RefusalLog
from dappled.workers import Loop

log = logging.getLogger(__name__)
_BACKLOG = 128
_END_S = 3.0  # the process itself waits 2 s for viewers to read what it has
_STOP_S = 6.0


class TcpRelay:
    """Keeps the relaying process running where there is a tcp endpoint, started at most five times a minute. Whom it
    refused is written to `refusals`."""

    def __init__(self, refusals: RefusalLog, budget: RestartBudget | None = None) -> None:
        self._refusals = refusals
        self._routes: dict[str, socket.socket] = {}  # by path
        self._process: subprocess.Popen[bytes] | None = None
        self._budget = budget or RestartBudget(limit=5, window_s=60.0)
        self._loop = Loop("relay", self._run)

    def listen(self, endpoint: str) -> str:
        """Listen on a tcp endpoint; returns the ipc endpoint to bind in its place. Raises WireError."""
        listener = _listener(endpoint)
        path = configuration.runtime_folder() / f"tcp-{os.getpid()}-{secrets.token_hex(4)}"
        self._routes[str(path)] = listener
        return f"ipc://{path}"

    def start(self) -> None:
        """Start the process, if there is anything to listen on."""
        if self._routes:
            self._loop.start()

    def stop(self) -> None:
        """End the process when viewers have read what it has, in two seconds at most, and close the sockets."""
        self._loop.stop(_STOP_S)
        for listener in self._routes.values():
            listener.close()

    def dead_threads(self) -> list[str]:
        """See `Loop.dead_threads`."""
        return self._loop.dead_threads()

    def _run(self) -> None:
        while not self._loop.stopping.is_set():
            if wait_ns := self._budget.wait_ns(time.monotonic_ns()):
                log.warning("the process for TCP viewers ended too often; the next attempt is in %.0f s", wait_ns / 1e9)
                self._loop.stopping.wait(wait_ns / 1e9)
                continue
            self._budget.spend(time.monotonic_ns())
            try:
                self._relay()
            except Exception as error:  # noqa: BLE001  # it is started again in any case, at most five times a minute
                report(log, "the process for TCP viewers", error)

    def _relay(self) -> None:
        channel, there = ProcessChannel.pair()
        try:
            with there:
                routes = [(listener.fileno(), path) for path, listener in self._routes.items()]
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        *("-m", "dappled.daemon.stream.relay_process", str(there.fileno())),
                        *(str(part) for route in routes for part in route),
                    ],
                    pass_fds=[there.fileno(), *(descriptor for descriptor, _ in routes)],
                    stdin=subprocess.DEVNULL,
                )
            while not self._loop.stopping.is_set():
                self._refusals.settle()
                message = channel.receive(0.2)
                for address, reason, count in message.body.get("refused", ()) if message is not None else ():
                    self._refusals.refused(str(address), str(reason), int(count))
        except ChannelError as error:
            if not self._loop.stopping.is_set():
                log.warning("the process for TCP viewers ended: %s", error)
        finally:
            channel.close()  # this ends the process
            process, self._process = self._process, None
            if process is not None:
                end_child(process, _END_S)


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
