"""Open connection strings as byte channels: UDP, TCP and serial, never blocking."""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
import termios
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Literal, Protocol

from dappled.clock import Clock
from dappled.drivers.mavlink.peers import OnePeer, Peers, Shown, Source
from dappled.drivers.mavlink.streams import ByteStream, TcpServer, over_tcp
from dappled.errors import DappledError

LinkKind = Literal["udpin", "udpout", "udpbcast", "tcp", "tcpin", "serial"]
FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or /dev/ttyX[,BAUD]"
DEFAULT_BAUD = 115200
_SCHEMES: dict[str, LinkKind] = {
    "udp": "udpin",
    "udpin": "udpin",
    "udpout": "udpout",
    "udpbcast": "udpbcast",
    "tcp": "tcp",
    "tcpin": "tcpin",
}
_CHUNK = 65536
_DRAINED = 512  # datagrams at once, so that the kernel's buffer holds those that come meanwhile
_KNOWN_IN_A_ROW = 32  # then a stranger's turn comes: without a key anybody may be known, and flood
_KERNEL_BYTES = 4 << 20
_SO_RCVBUFFORCE = 33  # socket(7)
_NO_DATAGRAM = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ECONNREFUSED)  # the last: no program listens there yet
_FINAL = (errno.EADDRINUSE, errno.EACCES, errno.EPERM)
"""What waiting does not mend: another program has the port, or this user may not listen on it. A device is another
matter: it may be there before udev has given it to its group."""

FORBIDDEN = {
    errno.EACCES: "add the user to the group of the device",
    errno.EPERM: "restart the service: devices of this kind came after it had started, and systemd keeps it from them",
}
"""What to do where this process may not open a serial device."""


class LinkError(DappledError):
    """A link can't be opened: one sentence with the url and what to do. `may_come`: a device, an address or a peer is
    not there now, and waiting may mend it."""

    def __init__(self, text: str, *, may_come: bool = False) -> None:
        super().__init__(text)
        self.may_come = may_come


@dataclass(frozen=True, slots=True)
class Address:
    """One parsed connection string. `port` is the UDP or TCP port, or the baud rate of a serial device."""

    url: str
    kind: LinkKind
    host: str
    port: int

    @property
    def exposed(self) -> bool:
        """Whether others than this machine's users can reach it: it is no serial line, and not on loopback."""
        if self.kind == "serial" or self.host == "localhost":
            return False
        try:
            return not ipaddress.ip_address(self.host).is_loopback
        except ValueError:  # a name, which anybody may own
            return True


def parse(url: str) -> Address:
    """Parse `url`. `udp:HOST:PORT` and `HOST:PORT` listen, as in pymavlink. Raises LinkError."""
    scheme, colon, rest = url.partition(":")
    if url.startswith("/") or scheme == "serial":
        return serial_address(url, url if url.startswith("/") else rest)
    kind = _SCHEMES.get(scheme)
    if colon and kind is not None:
        return _socket_address(url, kind, rest)
    if url.count(":") == 1 and rest.isdigit():
        return _socket_address(url, "udpin", url)
    raise LinkError(f"mavlink.url {url!r} is not a connection string; write {FORMS}")


def _socket_address(url: str, kind: LinkKind, rest: str) -> Address:
    host, _, port = rest.rpartition(":")
    if not host or ":" in host:
        raise LinkError(f"mavlink.url {url!r} needs a host and a port, as in {kind}:127.0.0.1:14550")
    if not (port.isascii() and port.isdigit() and int(port) <= 65535):
        raise LinkError(f"mavlink.url {url!r}: {port!r} is not a port; write a number up to 65535")
    if kind not in ("udpin", "tcpin") and int(port) == 0:
        raise LinkError(
            f"mavlink.url {url!r}: port 0 can't be connected to; write the port that the other side listens on"
        )
    return Address(url, kind, host, int(port))


def serial_address(url: str, rest: str, setting: str = "mavlink.url") -> Address:
    """Parse DEVICE[,BAUD] of `url`; `setting` names it in sentences. Raises LinkError."""
    device, separator, baud = rest.replace(":", ",").partition(",")
    if not device.startswith("/"):
        raise LinkError(f"{setting} {url!r} needs a device, as in /dev/ttyAMA0,921600")
    if separator and not (baud.isascii() and baud.isdigit()):
        raise LinkError(f"{setting} {url!r}: {baud!r} is not a baud rate; write a number such as {DEFAULT_BAUD}")
    speed = int(baud) if separator else DEFAULT_BAUD
    if not hasattr(termios, f"B{speed}"):
        raise LinkError(f"{setting} {url!r}: a serial port can't run at {speed} baud; write 57600, 115200 or 921600")
    return Address(url, "serial", device, speed)


class ByteChannel(Protocol):
    """One open connection. One thread reads; `write` is called under the link's lock."""

    datagrams: bool  # `read` returns whole packets

    @property
    def origin(self) -> int:
        """Whose bytes were read last, where several are read in turn."""

    def ask_proof(self) -> None:
        """The link has a key: nobody is served who has not proven itself."""

    def descriptors(self) -> Sequence[int]:
        """The descriptors to poll: any of them may become readable."""

    def read(self) -> bytes | None:
        """Return what has come, b"" for nothing yet, None when the other side has closed. Raises OSError when
        broken."""

    def shown(self, evidence: Shown) -> None:
        """A packet of what was read last was judged. Under the link's lock."""

    def source(self) -> str:
        """Return the address that what was read last came from, "" where only one can be at the other end."""

    def write(self, data: bytes) -> bool:
        """Send without blocking. False: not sent (no receiver, or the buffer is full). Raises OSError when broken."""

    def wants_write(self) -> bool:
        """Return whether bytes wait until the descriptor can take them."""

    def flush(self) -> None:
        """Send what waits. Raises OSError when broken."""

    def port(self) -> int:
        """Return the local port, 0 where there is none."""

    def close(self) -> None:
        """Close every descriptor."""


class Transport(Protocol):
    """What opens channels, and waits for them."""

    def open(self, address: Address) -> ByteChannel:
        """Open the connection that `address` names. Raises LinkError, in words."""

    def wait(self, channel: ByteChannel, timeout_s: float) -> tuple[bool, bool]:
        """Until there is something to read, or room to write what waits: whether each is so."""


class MachineTransport:
    """The machine's sockets and serial devices."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def open(self, address: Address) -> ByteChannel:
        """Open the connection that `address` names."""
        return open_channel(address, self._clock)

    def wait(self, channel: ByteChannel, timeout_s: float) -> tuple[bool, bool]:
        """Wait until a channel can be read or written. poll takes descriptors above 1023, select does not."""
        poll = select.poll()
        for descriptor in channel.descriptors():
            poll.register(descriptor, select.POLLIN | (select.POLLOUT if channel.wants_write() else 0))
        ready = reduce(or_, (events for _, events in poll.poll(timeout_s * 1e3)), 0)
        return bool(ready & ~select.POLLOUT), bool(ready & select.POLLOUT)


def open_channel(address: Address, clock: Clock) -> ByteChannel:
    """Open the connection that `address` names."""
    try:
        if address.kind == "serial":
            return over_serial(address)
        if address.kind == "tcp":
            return over_tcp(socket.create_connection((address.host, address.port), timeout=1.0))
        if address.kind == "tcpin":
            return TcpServer(_bound(address, socket.SOCK_STREAM))
        if address.kind == "udpin":
            return UdpIn(_bound(address, socket.SOCK_DGRAM), clock)
        return UdpOut(address)
    except OSError as error:
        may_come = address.kind == "serial" or error.errno not in _FINAL
        raise LinkError(_sentence(address, error), may_come=may_come) from error


def _sentence(address: Address, error: OSError) -> str:
    url = address.url
    if isinstance(error, socket.gaierror):
        return f"MAVLink link {url}: there is no machine named {address.host!r}; write an address such as 127.0.0.1"
    if error.errno == errno.EADDRINUSE:
        return (
            f"MAVLink link {url}: port {address.port} is in use; end the program that listens there or change the port"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return f"MAVLink link {url}: {address.host} is not an address of this machine; 0.0.0.0 listens on all of them"
    if error.errno == errno.ENOENT:
        return f"MAVLink link {url}: there is no device {address.host}; plug it in or correct mavlink.url"
    if error.errno in FORBIDDEN:
        todo = FORBIDDEN[error.errno] if address.kind == "serial" else "choose a port above 1023"
        return f"MAVLink link {url}: no permission to open {address.host}; {todo}"
    return f"MAVLink link {url}: {error.strerror or error}; correct mavlink.url or repair the connection"


def _bound(address: Address, kind: socket.SocketKind) -> socket.socket:
    found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, kind)
    sock = socket.socket(socket.AF_INET, kind)
    try:
        if kind == socket.SOCK_STREAM:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setblocking(False)
        sock.bind(found[0][4])
        if kind == socket.SOCK_STREAM:
            sock.listen(1)
    except OSError:
        sock.close()
        raise
    return sock


# --- UDP


class _Udp(OnePeer):
    """A UDP socket: each datagram holds whole packets, and writing never has to wait."""

    datagrams = True

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._last: tuple[bytes, Source] | None = None

    def descriptors(self) -> Sequence[int]:
        return (self._sock.fileno(),)

    def read(self) -> bytes | None:
        self._last = self._receive()
        return b"" if self._last is None else self._last[0]

    def source(self) -> str:
        return "" if self._last is None else "{}:{}".format(*self._last[1])

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._sock.close()

    def _receive(self) -> tuple[bytes, Source] | None:
        try:
            data, source = self._sock.recvfrom(_CHUNK)
        except OSError as error:
            if error.errno in _NO_DATAGRAM:
                return None
            raise
        return data, source

    def _send(self, data: bytes, to: Source) -> bool:
        try:
            self._sock.sendto(data, to)
        except OSError:  # no program listens there, or the network is down: the next packet tries again
            return False
        return True


class UdpIn(_Udp):
    """Listen, and send to the peers that have proven themselves. What they send is read before what strangers send."""

    def __init__(self, sock: socket.socket, clock: Clock) -> None:
        super().__init__(sock)
        self._clock, self._peers = clock, Peers()
        self._known, self._strange = deque[tuple[bytes, Source]](), deque[tuple[bytes, Source]]()
        self._in_a_row = 0
        self._waiting = Counter[Source]()  # in `_strange`: a peer that proves itself meanwhile keeps its order
        for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first one passes the kernel's limit, where it may
            try:
                sock.setsockopt(socket.SOL_SOCKET, option, _KERNEL_BYTES)
            except PermissionError:
                continue
            break

    def read(self) -> bytes | None:
        if not self._known and len(self._strange) < _DRAINED:
            self._drain()
        if self._known and not (self._strange and self._in_a_row >= _KNOWN_IN_A_ROW):
            self._in_a_row += 1
            self._last = self._known.popleft()
        elif self._strange:
            self._in_a_row = 0
            self._last = self._strange.popleft()
            self._waiting[self._last[1]] -= 1
            if not self._waiting[self._last[1]]:  # strangers can have any number of addresses
                del self._waiting[self._last[1]]
        else:
            self._last = None
        return b"" if self._last is None else self._last[0]

    def shown(self, evidence: Shown) -> None:
        if self._last is not None:
            data, source = self._last
            self._peers.shown(source, len(data), evidence, self._clock.monotonic_ns())

    def write(self, data: bytes) -> bool:
        sent = [self._send(data, source) for source in self._peers.receivers(len(data), self._clock.monotonic_ns())]
        return any(sent)

    def _drain(self) -> None:
        now_ns = self._clock.monotonic_ns()
        for _ in range(_DRAINED):
            received = self._receive()
            if received is None:
                return
            if not received[0]:  # it would end the reading of those that wait
                continue
            source = received[1]
            if self._peers.is_proven(source, now_ns) and not self._waiting[source]:
                self._known.append(received)
            else:
                self._strange.append(received)
                self._waiting[source] += 1


class UdpOut(_Udp):
    """Send to one address, and hear what comes back."""

    def __init__(self, address: Address) -> None:
        """Raises OSError."""
        found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, socket.SOCK_DGRAM)
        self._to = (str(found[0][4][0]), int(found[0][4][1]))
        broadcast = address.kind == "udpbcast"
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        if broadcast:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        near = self._to[0].startswith("127.") and not broadcast
        self._sock.bind(("127.0.0.1" if near else "0.0.0.0", 0))  # noqa: S104  # a client's own port: answers come back to it

    def write(self, data: bytes) -> bool:
        return self._send(data, self._to)


# --- serial


def over_serial(address: Address) -> ByteStream:
    """Open a serial device in raw mode, 8N1, without flow control. Raises OSError, and LinkError for another kind of
    file."""
    speed = getattr(termios, f"B{address.port}")
    fd = os.open(address.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        attributes = termios.tcgetattr(fd)
        attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
        attributes[:6] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0, speed, speed]
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
    except termios.error as error:
        os.close(fd)
        raise LinkError(
            f"MAVLink link {address.url}: {address.host} is not a serial device; correct mavlink.url"
        ) from error
    return ByteStream(fd, lambda: os.close(fd))
