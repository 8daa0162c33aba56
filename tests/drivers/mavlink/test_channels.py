"""Connection strings as pymavlink's users write them, and what becomes of TCP clients that leave."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time

import pytest

from dappled.drivers.mavlink.channels import Address, LinkError, parse
from dappled.drivers.mavlink.streams import TcpServer, over_tcp


@pytest.mark.parametrize(
    ("url", "kind", "host", "port"),
    [
        ("udpin:192.0.2.1:14550", "udpin", "192.0.2.1", 14550),
        ("udp:127.0.0.1:14550", "udpin", "127.0.0.1", 14550),
        ("127.0.0.1:14550", "udpin", "127.0.0.1", 14550),
        ("udpout:drone.local:14551", "udpout", "drone.local", 14551),
        ("tcp:10.0.0.1:5760", "tcp", "10.0.0.1", 5760),
        ("tcpin:192.0.2.1:5760", "tcpin", "192.0.2.1", 5760),
        ("/dev/ttyAMA0", "serial", "/dev/ttyAMA0", 115200),
        ("/dev/ttyUSB0,57600", "serial", "/dev/ttyUSB0", 57600),
        ("serial:/dev/ttyUSB0:921600", "serial", "/dev/ttyUSB0", 921600),
    ],
)
def test_forms(url: str, kind: str, host: str, port: int) -> None:
    assert parse(url) == Address(url, kind, host, port)  # type: ignore[arg-type]  # kinds come as plain text here


@pytest.mark.parametrize(
    "url",
    ["", "udpin:", "udpin:127.0.0.1", "udpin:127.0.0.1:x", "udpout:h:0", "tcp:h:70000", "COM3", "serial:x", "/d,x"],
)
def test_a_malformed_url_is_named_in_the_sentence(url: str) -> None:
    with pytest.raises(LinkError, match=r"mavlink\.url"):
        parse(url)


def test_a_client_is_not_closed_while_another_thread_writes_to_it() -> None:
    """Its descriptor could be another file's by then."""
    told: list[str] = []
    began, go_on = threading.Event(), threading.Event()

    class Slow:
        def write(self, _data: bytes) -> bool:
            told.append("begun")
            began.set()
            assert go_on.wait(60)
            told.append("written")
            return True

        def close(self) -> None:
            told.append("closed")

    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        listener = TcpServer(server)
        listener._client = Slow()  # type: ignore[assignment]  # all that is asked of one
        writer = threading.Thread(target=listener.write, args=[b"x"])
        writer.start()
        assert began.wait(60)
        with socket.create_connection(server.getsockname()):
            reader = threading.Thread(target=listener.read)
            reader.start()
            reader.join(0.1)
            assert told == ["begun"]
            go_on.set()
            for thread in (writer, reader):
                thread.join(60)
            assert told == ["begun", "written", "closed"]
        listener.close()


@pytest.mark.parametrize("number", [errno.ECONNABORTED, errno.EHOSTUNREACH])
def test_a_client_that_left_before_it_was_accepted_does_not_break_the_link(number: int) -> None:
    class Deserted:
        """A listening socket whose client leaves before it is accepted."""

        def __init__(self, sock: socket.socket) -> None:
            self.sock, self.away = sock, True

        def accept(self) -> tuple[socket.socket, object]:
            if self.away:
                self.away = False
                raise OSError(number, os.strerror(number))
            return self.sock.accept()

        def close(self) -> None:
            self.sock.close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        listening = Deserted(server)
        server.setblocking(False)
        listener = TcpServer(listening)  # type: ignore[arg-type]  # all that it asks of one
        with socket.create_connection(server.getsockname()) as client:
            assert listener.read() == b""  # the one that left
            client.sendall(b"here")
            deadline, heard = time.monotonic() + 60, listener.read()
            while not heard:
                assert time.monotonic() < deadline
                listening.away = not listening.away  # again and again
                heard = listener.read()
            assert heard == b"here"
        listener.close()


def test_a_connection_whose_other_side_vanished_fails_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as client:
        over_tcp(client)
        # The kernel's own limits are a quarter of an hour where something was sent, and two hours where nothing was.
        assert client.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 5000
        assert client.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        assert client.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 2
        assert client.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL) == 1
