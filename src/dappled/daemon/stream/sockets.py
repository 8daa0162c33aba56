"""Open the sockets that other programs connect to: safe endpoints, key checks, limits for peers that do not read."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import socket
import stat
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq

from dappled.clock import Clock
from dappled.daemon.stream import curve
from dappled.daemon.stream.curve import ServerKeys
from dappled.daemon.stream.relay import TcpRelay, tcp_address
from dappled.daemon.stream.wire import WireError
from dappled.findings import Code, Subject, finding
from dappled.refusals import RefusalLog
from dappled.workers import Loop, renice

log = logging.getLogger(__name__)
NICENESS = 12  # below the decoder's 10
QUESTION_BYTES = 4096
ROOM_BYTES = (
    1 << 20
)  # of kernel memory for a reader over ipc: the default of 208 kB makes both ends wait for each other
_HEARTBEAT_MS, _DEAF_MS = 5_000, 30_000  # a peer that reads nothing for so long is disconnected; it may come again
_PATH_BYTES = 107  # of sockaddr_un
_BEGIN_S = 10.0
_OWN_MODE = 0o600
_PEER = struct.Struct("3i")  # of unix(7): process, user, group
_EVENT = struct.Struct("=HI")  # of a monitor: its kind and value; zmq.utils.monitor, which reads it too, loads asyncio


class Sockets:
    """Opens sockets of one context and closes them all. `keys` turn CURVE on for tcp, `mode` is the file mode of ipc
    sockets. A process of its own listens on tcp, see `TcpRelay`. One thread calls it."""

    def __init__(self, keys: ServerKeys | None, mode: int, clock: Clock) -> None:
        self._keys, self._mode = keys, mode
        self._context = niced_context()
        self._bound: list[str] = []
        self._sockets: list[zmq.Socket[Any]] = []
        self._refusals = RefusalLog(log, clock)
        self._relay = TcpRelay(self._refusals, clock)
        self.wrong_keys = 0
        self._monitors: list[zmq.Socket[Any]] = []
        self._judge: zmq.Socket[Any] | None = None
        if keys is not None:  # ZeroMQ asks this socket about keys: it must be bound before the first endpoint
            self._judge = self._context.socket(zmq.REP)
            self._judge.bind(curve.ZAP_ENDPOINT)

    @property
    def fds(self) -> list[int]:
        """The descriptors to poll before `let_in`."""
        return [int(one.FD) for one in (*self._monitors, *([self._judge] if self._judge else []))]

    def open(self, kind: int, wanted: Sequence[str], high_water_mark: int) -> zmq.Socket[Any]:
        """A socket bound to all of the `wanted` endpoints that are not "". Raises WireError; all are closed then."""
        one: zmq.Socket[Any] = self._context.socket(kind)
        self._sockets.append(one)
        one.setsockopt(zmq.LINGER, 0)
        one.setsockopt(zmq.SNDHWM, high_water_mark)
        one.setsockopt(zmq.RCVHWM, 100)
        one.setsockopt(zmq.MAXMSGSIZE, QUESTION_BYTES)
        one.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        one.setsockopt(zmq.HEARTBEAT_TIMEOUT, _DEAF_MS)
        if kind == zmq.ROUTER:
            one.setsockopt(zmq.ROUTER_MANDATORY, 1)
        else:
            self._monitors.append(one.get_monitor_socket(zmq.EVENT_ACCEPTED))
        try:
            for endpoint in filter(None, wanted):
                prepare(endpoint, keyed=self._keys is not None)
                if endpoint.startswith("ipc://"):
                    bind(one, endpoint, mode=self._mode)
                    self._bound.append(endpoint)
                else:
                    self._bind_relayed(one, endpoint)
        except WireError:
            self.close(0.0)
            raise
        return one

    def _bind_relayed(self, one: zmq.Socket[Any], endpoint: str) -> None:
        inner = self._relay.listen(endpoint)
        prepare(inner)
        bind(one, inner, keys=self._keys, mode=_OWN_MODE)
        self._bound.append(inner)

    def start(self) -> None:
        """Let viewers in over tcp."""
        self._relay.start()

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        return self._relay.dead_threads()

    def let_in(self) -> None:
        """Answer ZeroMQ about the keys of new peers, and give new readers more kernel memory."""
        for monitor in self._monitors:
            while monitor.poll(0):
                _give_room(_EVENT.unpack(monitor.recv_multipart()[0])[1])
        while self._judge is not None:
            try:
                request = self._judge.recv_multipart(flags=zmq.NOBLOCK)
            except zmq.Again:
                return
            answer, name = curve.judge(request, self._keys.allowed if self._keys else {})
            self._judge.send_multipart(answer)
            if name is not None:
                log.info("%s connected with its key", name)
                continue
            self.wrong_keys += 1
            self._refusals.refused(finding(Code.PEER_KEY_UNLISTED, Subject("peer", "a viewer")))

    def close(self, linger_s: float) -> None:
        """Close all; messages already sent have this long to go out."""
        for endpoint in self._bound:
            unlink(endpoint)
        for one in self._sockets:
            one.disable_monitor()
        for monitor in self._monitors:
            monitor.close(linger=0)
        for one in self._sockets:
            one.close(linger=round(linger_s * 1000))
        if self._judge is not None:
            self._judge.close(linger=0)
        self._context.term()
        self._relay.stop()


def prepare(endpoint: str, *, keyed: bool = False) -> None:
    """Make an endpoint safe to bind: ipc folders exist and are private; tcp off loopback only with keys.

    Raises WireError with what to do.
    """
    check_endpoint(endpoint, keyed=keyed)
    if endpoint.startswith("ipc://"):
        path = Path(endpoint.removeprefix("ipc://"))
        _prepare_folder(path.parent, endpoint)
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            raise WireError(f"{endpoint}: there is a file of this name that is not a socket; choose another endpoint")


def check_endpoint(endpoint: str, *, keyed: bool) -> None:
    """Raise WireError, with what to do, where an endpoint can't be bound as it is written. Nothing is opened."""
    scheme = endpoint.partition("://")[0]
    if scheme == "ipc":
        path = Path(endpoint.removeprefix("ipc://"))
        if not path.is_absolute() or len(str(path).encode()) > _PATH_BYTES:
            raise WireError(f"{endpoint} must be an absolute path of at most {_PATH_BYTES} bytes")
    elif scheme == "tcp":
        if not is_loopback(tcp_address(endpoint)[0]) and not keyed:
            raise WireError(
                f"{endpoint} would be open to the network without keys: make them with `dappled keys make`, and name "
                "them in publish.keys and publish.clients; or use ipc:// or tcp://127.0.0.1:PORT"
            )
    else:
        raise WireError(f"{endpoint} is neither ipc:// nor tcp://")


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host by this name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bind(one: zmq.Socket[Any], endpoint: str, *, keys: ServerKeys | None = None, mode: int = 0o660) -> None:
    """Bind a socket to an ipc endpoint that `prepare` has checked. `keys` turn CURVE on, `mode` is its file's.

    Raises WireError where it is in use or can't be bound.
    """
    path = endpoint.removeprefix("ipc://")
    if listener(path) is not None:  # ZeroMQ would replace it silently
        raise WireError(f"{endpoint} is in use by another program; stop it, or choose another endpoint")
    one.curve_server = keys is not None
    if keys is not None:
        one.curve_secretkey, one.curve_publickey = keys.own.secret, keys.own.public
    try:
        one.bind(endpoint)
    except zmq.ZMQError as error:
        raise WireError(f"{endpoint} can't be bound ({error.strerror}); choose another endpoint") from None
    Path(path).chmod(mode)  # it was 0755 until now: no other user could connect


def niced_context() -> zmq.Context[Any]:
    """A context whose own thread, which does the copying, runs at a lower priority than decoding.

    The thread is made with the first socket, and inherits the niceness of the thread that makes it.
    """
    made: zmq.Context[Any] = zmq.Context()

    def begin() -> None:
        renice(NICENESS)
        made.socket(zmq.PAIR).close()

    starter = Loop("publisher context", begin)
    starter.start()
    starter.stop(_BEGIN_S)
    return made


def unlink(endpoint: str) -> None:
    """Remove the file of an ipc socket, which ZeroMQ leaves behind. Call it while the socket is still bound."""
    if endpoint.startswith("ipc://"):
        Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)


def _prepare_folder(folder: Path, endpoint: str) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise WireError(
            f"{endpoint}: its folder can't be created ({error.strerror}); choose another endpoint"
        ) from None
    if folder.stat().st_uid not in (0, os.getuid()):
        raise WireError(f"{endpoint}: {folder} belongs to another user; choose another endpoint")


def listener(path: str) -> int | None:
    """The user id of the program that listens on this UNIX socket; None where none does."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1)
        try:
            probe.connect(path)
            facts = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        except OSError:
            return None
    return int(_PEER.unpack(facts)[1])


def _give_room(descriptor: int) -> None:
    """Enlarge the send buffer of an ipc connection, up to net.core.wmem_max. ZeroMQ's own option works for TCP only.

    Where the peer has already gone, the descriptor may belong to another socket by now; that one is enlarged then.
    """
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            with socket.socket(fileno=os.dup(descriptor)) as one:
                if one.family == socket.AF_UNIX:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM_BYTES)
