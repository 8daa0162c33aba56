"""A body on a USB bus: a USB/IP server that passes a still image device's transfers to it, and makes the bus' faults.

The kernel of the machine that attaches it (`usbip attach -r HOST -b 1-1`) sees a Canon EOS 450D on a bus of its own.
Sources: Documentation/usb/usbip_protocol.rst of Linux; USB 2.0, chapter 9; USB Still Image Capture Device 1.0. As with
bodies of that age there is no serial number in the descriptors.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import socket
import struct
import sys
import threading
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

from dappled.mocks.body import body, ptp
from dappled.mocks.body.eos450d import Eos450d
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptpip import exactly
from dappled.workers import Loop

BUS_ID = "1-1"
_VERSION, _DEVLIST, _IMPORT = 0x0111, 0x8005, 0x8003
_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_HIGH_SPEED = 3
_PACKET = 512
_CONTROL, _BULK_IN, _BULK_OUT, _INTERRUPT = 0, 1, 2, 3
_COMMAND, _DATA, _RESPONSE = 1, 2, 3  # types of containers
_MOST_BYTES = 16 << 20
_CANON, _EOS_450D = 0x04A9, 0x3145
_DEVICE = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x200, 0, 0, 0, 64, _CANON, _EOS_450D, 1, 1, 2, 0, 1)
_PTP, _STORAGE = bytes((6, 1, 1)), bytes((8, 6, 0x50))  # class, subclass and protocol of an interface
_CONFIGURATION = b"".join(
    (
        struct.pack("<BBHBBBBB", 9, 2, 39, 1, 1, 0, 0xC0, 1),
        struct.pack("<BBBBB", 9, 4, 0, 0, 3) + _PTP + b"\0",
        struct.pack("<BBBBHB", 7, 5, 0x80 | _BULK_IN, 2, _PACKET, 0),
        struct.pack("<BBBBHB", 7, 5, _BULK_OUT, 2, _PACKET, 0),
        struct.pack("<BBBBHB", 7, 5, 0x80 | _INTERRUPT, 3, 8, 9),
    )
)
_QUALIFIER = struct.pack("<BBHBBBBBB", 10, 6, 0x200, 0, 0, 0, 64, 1, 0)
_STRINGS = ("", "Canon Inc.", "Canon Digital Camera")
_DESCRIPTORS: dict[int, tuple[bytes, ...]] = {
    1: (_DEVICE,),
    2: (_CONFIGURATION,),
    3: (struct.pack("<BBH", 4, 3, 0x0409),),
    6: (_QUALIFIER,),
}
_DESCRIPTORS[3] += tuple(bytes([2 + 2 * len(one), 3]) + one.encode("utf-16-le") for one in _STRINGS[1:])
_CANCEL, _DEVICE_RESET, _DEVICE_STATUS = 0x64, 0x66, 0x67


@dataclass(slots=True)
class _Urb:
    """A transfer that the host asked for, and what came of it so far."""

    number: int
    endpoint: int
    room: int
    got: bytearray = field(default_factory=bytearray)


@dataclass(frozen=True, slots=True)
class _End:
    """The last packet of a data phase is short; `empty`: it is one of its own, since all others are full."""

    empty: bool


class _Overflow:
    """The body sends more than the transfer has room for."""


class UsbIpResponder:
    """Serves one body at `BUS_ID`; `close` ends all its threads. One host at a time has it."""

    def __init__(self, body: Eos450d, faults: BodyFaults, address: tuple[str, int] = ("127.0.0.1", 0)) -> None:
        self._body = body
        self._faults = faults
        faults.drop = self.drop
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._link: socket.socket | None = None
        self._listener = socket.create_server(address)
        self.ports: list[int] = [self._listener.getsockname()[1]]
        self._loop = Loop("usbip", self._accept, self._closed)
        self._loop.start()

    def move(self) -> None:
        """The body leaves the bus; the host that attaches it again gives it another address."""
        self.drop()

    def close(self) -> None:
        """Stop listening and leave the bus."""
        self._closed.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop()
        self._loop.stop(5)

    def drop(self) -> None:
        """Leave the bus, as with a pulled cable."""
        with self._lock:
            if self._link is not None:
                with contextlib.suppress(OSError):
                    self._link.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                link, _address = self._listener.accept()
            except OSError:
                return  # closed
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            Loop("usbip-link", partial(self._greet, link), self._closed).start()

    def _greet(self, link: socket.socket) -> None:
        with link, contextlib.suppress(OSError, ptp.MalformedPacketError):  # the host is gone, or was none
            version, code, _status = struct.unpack(">HHI", exactly(link, 8))
            if code == _DEVLIST:
                link.sendall(struct.pack(">HHII", version, 0x0005, 0, 1) + _described() + _PTP + b"\0")
            elif code == _IMPORT:
                wanted = exactly(link, 32).rstrip(b"\0").decode("ascii", "replace")
                with self._lock:
                    here = wanted == BUS_ID and self._link is None and not self._faults.lasts("unplug")
                    self._link = link if here else self._link
                link.sendall(struct.pack(">HHI", version, 0x0003, int(not here)) + (_described() if here else b""))
                if here:
                    self._serve(link)

    def _serve(self, link: socket.socket) -> None:
        bus = _Bus(link, self._body, self._faults, self._closed)
        try:
            bus.run()
        finally:
            bus.close()
            self._body.disconnected()
            with self._lock:
                self._link = None


def _described() -> bytes:
    """The device as USB/IP describes it: path, bus id, numbers, speed, the device descriptor's fields."""
    path = f"/sys/devices/simulated/{BUS_ID}".encode().ljust(256, b"\0") + BUS_ID.encode().ljust(32, b"\0")
    return path + struct.pack(">IIIHHHBBBBBB", 1, 2, _HIGH_SPEED, _CANON, _EOS_450D, 1, 0, 0, 0, 1, 1, 1)


class _Bus:
    """The transfers between one host and the body."""

    def __init__(self, link: socket.socket, body: Eos450d, faults: BodyFaults, closed: threading.Event) -> None:
        self._link, self._body, self._faults, self._closed = link, body, faults, closed
        self._gone = threading.Event()
        self._lock = threading.Lock()  # guards all that follows, and the order on the link
        self._waiting: list[_Urb] = []
        self._flow: deque[memoryview | _End | _Overflow] = deque()
        self._halted: set[int] = set()
        self._heard = bytearray()
        self._round = 0  # a reset or a cancel begins another: what was under way is dropped
        self._request: ptp.PtpRequest | None = None
        self._asked: queue.SimpleQueue[tuple[int, ptp.PtpRequest, bytes] | None] = queue.SimpleQueue()
        self._answerer = Loop("usbip-body", self._answer_all, closed)

    def run(self) -> None:
        """Serve until the host or the body leaves (OSError)."""
        self._answerer.start()
        while True:
            command, number, _device, inward, endpoint = struct.unpack(">5I", exactly(self._link, 20))
            flags_on = exactly(self._link, 28)
            if command == _UNLINK:
                self._unlink(number, struct.unpack_from(">I", flags_on)[0])
                continue
            if command != _SUBMIT:
                raise ptp.MalformedPacketError(f"{command} is no command of USB/IP")
            size = struct.unpack_from(">i", flags_on, 4)[0]
            if not 0 <= size <= _MOST_BYTES:
                raise ptp.MalformedPacketError(f"a transfer of {size} bytes is more than a host ever asks for here")
            data = b"" if inward else exactly(self._link, size)
            with self._lock:
                self._submit(_Urb(number, endpoint, size), flags_on[20:], data)

    def close(self) -> None:
        """The link is gone."""
        self._gone.set()
        self._asked.put(None)

    # --- transfers, with the lock held

    def _submit(self, urb: _Urb, setup: bytes, data: bytes) -> None:
        if urb.endpoint == _CONTROL:
            answer = self._control(setup)
            self._done(urb, b"" if answer is None else answer[: urb.room], -errno.EPIPE if answer is None else 0)
        elif urb.endpoint == _BULK_OUT:
            self._take(data)
            self._done(urb, b"", 0, len(data))
        elif urb.endpoint in self._halted:
            self._done(urb, b"", -errno.EPIPE)
        else:
            self._waiting.append(urb)
            self._pour()

    def _unlink(self, number: int, unlinked: int) -> None:
        with self._lock:
            found = [urb for urb in self._waiting if urb.number == unlinked]
            self._waiting = [urb for urb in self._waiting if urb.number != unlinked]
            status = -errno.ECONNRESET if found else 0  # 0: it was done before
            self._link.sendall(struct.pack(">5Ii24x", _UNLINKED, number, 0, 0, 0, status))

    def _done(self, urb: _Urb, data: bytes | bytearray, status: int, size: int | None = None) -> None:
        length = len(data) if size is None else size
        self._link.sendall(struct.pack(">5Iiiiii8x", _SUBMITTED, urb.number, 0, 0, 0, status, length, 0, 0, 0) + data)

    def _pour(self) -> None:
        """Fill the transfers that wait for the bulk endpoint with what the body has to send."""
        waiting = [urb for urb in self._waiting if urb.endpoint == _BULK_IN]
        while self._flow and waiting:
            urb, piece = waiting[0], self._flow[0]
            if not isinstance(piece, memoryview):
                self._flow.popleft()
                if piece == _End(empty=False) and not urb.got:
                    continue  # it ended with the transfer before, which it filled
            else:
                room = urb.room - len(urb.got)
                urb.got += piece[:room]
                if len(piece) > room:
                    self._flow[0] = piece[room:]
                else:
                    self._flow.popleft()
                if len(urb.got) < urb.room:
                    continue
                if self._flow and self._flow[0] == _End(empty=False):
                    self._flow.popleft()
            self._waiting.remove(waiting.pop(0))
            self._done(urb, urb.got, -errno.EOVERFLOW if isinstance(piece, _Overflow) else 0)

    def _control(self, setup: bytes) -> bytes | None:
        """What the device answers to a request; None: it stalls."""
        kind, request, value, index, _length = struct.unpack("<BBHHH", setup)
        answer: bytes | None = b""
        match kind, request:
            case 0x80, 6:
                answer = dict(enumerate(_DESCRIPTORS.get(value >> 8, ()))).get(value & 0xFF)
                if answer is _CONFIGURATION and self._faults.lasts("storage"):
                    answer = answer.replace(_PTP, _STORAGE)
            case ((0x80 | 0x81 | 0x82), 0):
                answer = struct.pack("<H", int(kind == 0x82 and index & 0xF in self._halted))
            case 0x80, 8:
                answer = b"\1"  # the configuration
            case 0x81, 10:
                answer = b"\0"  # the setting of an interface
            case 0x00, 9:  # a configuration is set: after a reset of the port, too
                self._halted.clear()
                self._forget()
            case 0x02, 1:
                self._halted.discard(index & 0xF)
            case 0x21, _request if request == _CANCEL:
                self._drop_transfer()
            case 0x21, _request if request == _DEVICE_RESET:
                self._halted.clear()
                self._forget()
            case 0xA1, _request if request == _DEVICE_STATUS:
                answer = struct.pack("<HH", 4, ptp.ResponseCode.OK)
            case ((0x00 | 0x01), _):
                pass  # an interface or a feature is set
            case _:
                answer = None
        return answer

    def _drop_transfer(self) -> None:
        self._round += 1
        self._heard.clear()
        self._flow.clear()
        self._request = None

    def _forget(self) -> None:
        self._drop_transfer()
        self._body.disconnected()

    # --- transactions

    def _take(self, data: bytes) -> None:
        """Take in a piece of a container, and act when it is whole. Raises MalformedPacketError."""
        self._heard += data
        if len(self._heard) < 12:
            return
        length, kind, code, transaction = struct.unpack_from("<IHHI", self._heard)
        if len(self._heard) < length:
            return
        payload = bytes(self._heard[12:length])
        self._heard.clear()
        if kind == _COMMAND:
            if len(payload) % 4 or len(payload) > 20:
                raise ptp.MalformedPacketError(f"a command has up to five parameters, not {len(payload)} bytes")
            self._request = ptp.PtpRequest(code, transaction, struct.unpack(f"<{len(payload) // 4}I", payload))
        if self._request is not None and (kind == _DATA or code not in ptp.WITH_DATA_OUT):
            self._asked.put((self._round, self._request, payload if kind == _DATA else b""))
            self._request = None

    def _answer_all(self) -> None:
        with contextlib.suppress(OSError):  # the link is gone
            while (asked := self._asked.get()) is not None:
                self._answer(*asked)

    def _answer(self, number: int, request: ptp.PtpRequest, data: bytes) -> None:
        self._faults.wait_out_silence(self._gone)
        answer = self._body.answer(request, data)
        if answer.data is not None and not self._send_data(number, request, memoryview(answer.data)):
            return
        parameters = struct.pack(f"<{len(answer.parameters)}I", *answer.parameters)
        head = struct.pack("<IHHI", 12 + len(parameters), _RESPONSE, answer.code, request.transaction)
        self._send(number, memoryview(head + parameters), _End(empty=False))

    def _send_data(self, number: int, request: ptp.PtpRequest, data: memoryview) -> bool:
        """Send the data phase. False where a fault ended the transaction."""
        head = struct.pack("<IHHI", 12 + len(data), _DATA, request.code, request.transaction)
        end = _End(empty=(12 + len(data)) % _PACKET == 0)
        struck = self._faults.strikes(len(data))
        if struck:
            self._send(number, memoryview(head))
            self._send(number, data[: len(data) // 2 // _PACKET * _PACKET])
            if struck == "babble":
                self._send(number, _Overflow())
            elif struck == "stall":
                self._halt(_BULK_IN)
            else:
                self._faults.command(struck)
            return False
        self._send(number, memoryview(head), *([] if data else [end]))
        sent = 0
        for piece in self._faults.pieces(data, self._gone):
            sent += len(piece)
            self._send(number, piece, *([end] if sent == len(data) else []))
        return True

    def _send(self, number: int, *pieces: memoryview | _End | _Overflow) -> None:
        with self._lock:
            if number == self._round:
                self._flow.extend(pieces)
                self._pour()

    def _halt(self, endpoint: int) -> None:
        """Answer each transfer with an error until the host clears the endpoint's halt."""
        with self._lock:
            self._flow.clear()
            self._halted.add(endpoint)
            halted = [urb for urb in self._waiting if urb.endpoint == endpoint]
            self._waiting = [urb for urb in self._waiting if urb.endpoint != endpoint]
            for urb in halted:
                self._done(urb, urb.got, -errno.EPIPE)


class UsbBody(body.SimulatedBody):
    """A body on a USB bus, in a process of its own."""

    COMMAND: ClassVar = [sys.executable, __file__]


if __name__ == "__main__":
    body.main(lambda eos, faults, options: UsbIpResponder(eos, faults, (options.bind, 0)))
