"""A PTP/IP responder on a TCP port: passes transactions to a body, and makes the faults of the link.

As with a real body, one initiator at a time is served: a second one is refused while the first is connected.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from functools import partial

from dappled.mocks.body import ptp
from dappled.mocks.body.eos450d import MODEL, Eos450d
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptp import PtpPacket
from dappled.workers import Loop


class Responder:
    """Serves a body on ports of its own choosing; `close` ends all its threads. The body answers at the first of its
    `addresses`, the others refuse; `move` takes it to the next one."""

    def __init__(self, body: Eos450d, faults: BodyFaults, host: str = "127.0.0.1", addresses: int = 1) -> None:
        self._body = body
        self._faults = faults
        faults.drop = self.drop
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._links: set[socket.socket] = set()
        self._event: socket.socket | None = None
        self._taken = False  # by an initiator; until its last transaction has ended
        self._guid = os.urandom(16)
        self._listeners = [socket.create_server((host, 0)) for _ in range(addresses)]
        self.ports: list[int] = [each.getsockname()[1] for each in self._listeners]
        self._at = 0
        self._loops = [Loop("ptpip", partial(self._accept, number), self._closed) for number in range(addresses)]
        for loop in self._loops:
            loop.start()

    @property
    def port(self) -> int:
        """Where the body answers."""
        return self.ports[self._at]

    def move(self) -> None:
        """The body comes back at its next address, as USB bodies do when they are plugged in again."""
        self._at = (self._at + 1) % len(self.ports)
        self.drop()

    def close(self) -> None:
        """Stop listening and cut the links."""
        self._closed.set()
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        self.drop()
        for loop in self._loops:
            loop.stop(5)

    def drop(self) -> None:
        """Cut the links, as a pulled cable does."""
        with self._lock:
            for link in self._links:
                with contextlib.suppress(OSError):
                    link.shutdown(socket.SHUT_RDWR)

    def _accept(self, number: int) -> None:
        while not self._closed.is_set():
            try:
                link, _address = self._listeners[number].accept()
            except OSError:
                return  # closed
            if number != self._at or self._faults.lasts("unplug"):
                link.close()
                continue
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            Loop("ptpip-link", partial(self._greet, link), self._closed).start()

    def _greet(self, link: socket.socket) -> None:
        with self._lock:
            self._links.add(link)
        try:
            kind, _payload = _read(link)
            if kind == PtpPacket.INIT_COMMAND_REQUEST:
                self._serve(link)
            elif kind == PtpPacket.INIT_EVENT_REQUEST:
                self._hold(link)
        except (OSError, ptp.MalformedPacketError):
            pass  # the initiator is gone, or was none; the link ends below
        finally:
            with self._lock:
                self._links.discard(link)
            link.close()

    def _serve(self, link: socket.socket) -> None:
        with self._lock:
            taken = self._taken or self._faults.lasts("refuse")
            self._taken = self._taken or not taken
        if taken:
            link.sendall(ptp.packet(PtpPacket.INIT_FAIL, b"\2\0\0\0"))  # 2: busy
            return
        try:
            self._faults.wait_out_silence(self._closed)
            link.sendall(ptp.init_command_ack(1, self._guid, MODEL))
            while not self._closed.is_set():
                self._transact(link)
        finally:
            self._body.disconnected()
            with self._lock:
                event, self._event, self._taken = self._event, None, False
            if event is not None:
                with contextlib.suppress(OSError):
                    event.shutdown(socket.SHUT_RDWR)

    def _hold(self, link: socket.socket) -> None:
        """The event connection: acknowledged, probes answered, otherwise silent (EOS events are polled)."""
        with self._lock:
            self._event = link
        link.sendall(ptp.packet(PtpPacket.INIT_EVENT_ACK))
        while True:
            kind, _payload = _read(link)
            if kind == PtpPacket.PROBE_REQUEST:
                link.sendall(ptp.packet(PtpPacket.PROBE_RESPONSE))

    def _transact(self, link: socket.socket) -> None:
        kind, payload = _read(link)
        if kind != PtpPacket.REQUEST:
            return  # a cancel, or data without a request
        request = ptp.parse_request(payload)
        data = _read_data(link) if request.code in ptp.WITH_DATA_OUT else b""
        self._faults.wait_out_silence(self._closed)
        answer = self._body.answer(request, data)
        if answer.data is not None:
            size = len(answer.data)
            link.sendall(ptp.start_data(request.transaction, size) + ptp.end_data_header(request.transaction, size))
            if struck := self._faults.strikes(size):
                link.sendall(answer.data[: size // 2])
                self._faults.command("unplug" if struck == "unplug" else "drop")
                return
            for piece in self._faults.pieces(memoryview(answer.data), self._closed):
                link.sendall(piece)
        link.sendall(ptp.response(answer.code, request.transaction, answer.parameters))


def _read(link: socket.socket) -> tuple[int, bytes]:
    kind, size = ptp.header(exactly(link, 8))
    if size > 1 << 20:
        raise ptp.MalformedPacketError(f"a packet of {size} bytes is more than an initiator ever sends here")
    return kind, exactly(link, size)


def _read_data(link: socket.socket) -> bytes:
    pieces: list[bytes] = []
    while True:
        kind, payload = _read(link)
        if kind in (PtpPacket.DATA, PtpPacket.END_DATA):
            pieces.append(payload[4:])
        if kind == PtpPacket.END_DATA:
            return b"".join(pieces)


def exactly(link: socket.socket, size: int) -> bytes:
    """Read so many bytes. Raises OSError."""
    pieces = bytearray()
    while len(pieces) < size:
        piece = link.recv(size - len(pieces))
        if not piece:
            raise ConnectionResetError("the initiator hung up")
        pieces += piece
    return bytes(pieces)
