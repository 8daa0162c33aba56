"""Binding ZeroMQ sockets so that nobody gets in who should not: modes of ipc sockets, keys off loopback."""

from __future__ import annotations

import ipaddress
import os
import socket
import stat
import threading
import urllib.parse
from pathlib import Path
from typing import Any

import zmq

from dappled.daemon.stream.curve import ServerKeys
from dappled.daemon.stream.wire import WireError

NICENESS = 12  # below the decoder's 10
_PATH_BYTES = 107  # of sockaddr_un


def prepare(endpoint: str, *, keyed: bool = False) -> None:
    """Make an endpoint safe to bind: ipc folders exist and are private; tcp off loopback only with keys.

    Raises WireError with what to do.
    """
    url = urllib.parse.urlsplit(endpoint)
    if url.scheme == "ipc":
        path = Path(endpoint.removeprefix("ipc://"))
        if not path.is_absolute() or len(str(path).encode()) > _PATH_BYTES:
            raise WireError(f"{endpoint} must be an absolute path of at most {_PATH_BYTES} bytes")
        _prepare_folder(path.parent, endpoint)
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            raise WireError(f"{endpoint}: a file that is no socket stands there; choose another endpoint")
    elif url.scheme == "tcp":
        if not keyed and not is_loopback(url.hostname or ""):
            raise WireError(
                f"{endpoint} would be open to the network without keys: make some with `dappled keys make`, and name "
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
    """Bind a socket to an endpoint that was prepared; `keys` hold for tcp, `mode` for an ipc socket's file.

    Raises WireError where it is taken or can't be had.
    """
    ipc = endpoint.startswith("ipc://")
    if ipc and _answers(endpoint.removeprefix("ipc://")):
        raise WireError(f"{endpoint} is in use by another program; stop it, or choose another endpoint")
    one.curve_server = keys is not None and not ipc
    if keys is not None and not ipc:
        one.curve_secretkey, one.curve_publickey = keys.own.secret, keys.own.public
    if not ipc and "[" in endpoint:
        one.setsockopt(zmq.IPV6, 1)
    try:
        one.bind(endpoint)
    except zmq.ZMQError as error:
        if error.errno == zmq.EADDRINUSE:
            raise WireError(f"{endpoint} is in use by another program; stop it, or choose another endpoint") from None
        raise WireError(f"{endpoint} can't be bound ({error.strerror}); choose another endpoint") from None
    if ipc:  # until now it was 0755: nobody else could connect
        Path(endpoint.removeprefix("ipc://")).chmod(mode)


def niced_context() -> zmq.Context[Any]:
    """A context whose own thread, which does the copying, comes after decoding. (It is made with the first socket, and
    a thread inherits the niceness of the one that makes it.)"""
    made: zmq.Context[Any] = zmq.Context()

    def begin() -> None:
        me = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + NICENESS)
        made.socket(zmq.PAIR).close()

    maker = threading.Thread(target=begin, name="publisher's maker")
    maker.start()
    maker.join()
    return made


def unlink(endpoint: str) -> None:
    """ZeroMQ leaves an ipc socket's file behind; while it is still bound nobody else can have taken the name."""
    if endpoint.startswith("ipc://"):
        Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)


def _prepare_folder(folder: Path, endpoint: str) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise WireError(f"{endpoint}: its folder can't be made ({error.strerror}); choose another endpoint") from None
    if folder.stat().st_uid not in (0, os.getuid()):
        raise WireError(f"{endpoint}: {folder} belongs to another user; choose another endpoint")


def _answers(path: str) -> bool:
    """Whether somebody listens on a UNIX socket: ZeroMQ would take its place without a word."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1)
        try:
            probe.connect(path)
        except OSError:
            return False
        return True
