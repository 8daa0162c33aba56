"""The sockets that strangers come to: bound safely, their keys judged, and who reads nothing is cut off in the end."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import stat
from collections.abc import Sequence
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from dappled.daemon.stream import curve, endpoints
from dappled.daemon.stream.curve import ServerKeys
from dappled.daemon.stream.wire import WireError

log = logging.getLogger(__name__)
QUESTION_BYTES = 4096
ROOM_BYTES = (
    1 << 20
)  # in the kernel, for a reader over ipc: with its 208 kB the two ends wait for each other all the time
_HEARTBEAT_MS, _DEAF_MS = 5_000, 30_000  # a peer that reads nothing for so long is cut off; it may come again


class Doors:
    """Opens sockets of one context and closes them all. `keys` turn CURVE on for those that are tcp, `mode` is that of
    ipc sockets. One thread calls it."""

    def __init__(self, keys: ServerKeys | None, mode: int) -> None:
        self._keys, self._mode = keys, mode
        self._context = endpoints.niced_context()
        self._bound: list[str] = []
        self._sockets: list[zmq.Socket[Any]] = []
        self.wrong_keys = 0
        self._newcomers: list[zmq.Socket[Any]] = []
        self._judge: zmq.Socket[Any] | None = None
        if keys is not None:  # whoever judges keys is there before the first door is opened
            self._judge = self._context.socket(zmq.REP)
            self._judge.bind(curve.ZAP_ENDPOINT)

    @property
    def fds(self) -> list[int]:
        """What to wait on for `let_in`."""
        return [int(one.FD) for one in (*self._newcomers, *([self._judge] if self._judge else []))]

    def open(self, kind: int, wanted: Sequence[str], high_water_mark: int) -> zmq.Socket[Any]:
        """A socket bound to all of the `wanted` endpoints that are not "". Raises WireError; then all are closed."""
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
            self._newcomers.append(one.get_monitor_socket(zmq.EVENT_ACCEPTED))
        try:
            for endpoint in filter(None, wanted):
                endpoints.prepare(endpoint, keyed=self._keys is not None)
                endpoints.bind(one, endpoint, keys=self._keys, mode=self._mode)
                self._bound.append(endpoint)
        except WireError:
            self.close(0.0)
            raise
        return one

    def let_in(self) -> None:
        """Judge the keys of those who connect, and give those who read room."""
        for door in self._newcomers:
            while door.poll(0):
                _give_room(recv_monitor_message(door)["value"])
        while self._judge is not None:
            try:
                request = self._judge.recv_multipart(flags=zmq.NOBLOCK)
            except zmq.Again:
                return
            answer, name = curve.judge(request, self._keys.allowed if self._keys else {})
            self._judge.send_multipart(answer)
            if name is not None:
                log.info("%s came with its key", name)
                continue
            self.wrong_keys += 1
            if self.wrong_keys == 1 or self.wrong_keys % 100 == 0:  # such a peer tries again and again
                log.warning("a peer whose key is not on the list was turned away (%d times)", self.wrong_keys)

    def close(self, linger_s: float) -> None:
        """Close all; what was sent may still go out for so long."""
        for endpoint in self._bound:
            endpoints.unlink(endpoint)
        for one in self._sockets:
            one.disable_monitor()
        for door in self._newcomers:
            door.close(linger=0)
        for one in self._sockets:
            one.close(linger=round(linger_s * 1000))
        if self._judge is not None:
            self._judge.close(linger=0)
        self._context.term()


def _give_room(descriptor: int) -> None:
    """More of the kernel's memory for a connection over ipc, as far as net.core.wmem_max lets it.

    ZeroMQ's own option is for TCP alone. Where the peer is gone again, the number may be another socket's by now: then
    that one has more room.
    """
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            with socket.socket(fileno=os.dup(descriptor)) as one:
                if one.family == socket.AF_UNIX:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM_BYTES)
