"""Connections over real sockets, served as the console serves: silent, slow and deaf ones lock nobody out."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import logging
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, StreamingResponse
from starlette.routing import Route

from dappled.clock import RecordedClock
from dappled.daemon.console import connection
from dappled.daemon.console.__main__ import configuration
from dappled.daemon.console.connection import Connection
from dappled.refusals import RefusalLog
from tests.waiting import eventually

WHOLE = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
ENDLESS = b"GET /endless HTTP/1.1\r\nHost: x\r\n\r\n"
SLOW = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{"


async def hello(request: Request) -> PlainTextResponse:
    with contextlib.suppress(ClientDisconnect):
        await request.body()
    client = request.client
    return PlainTextResponse("hello", headers={"x-client": client.host if client else ""})


async def endless(_: Request) -> StreamingResponse:
    async def flood() -> AsyncIterator[bytes]:
        while True:
            yield b"x" * 65_536
            await asyncio.sleep(0)

    return StreamingResponse(flood())


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(Connection, "request_s", 1.0)
    monkeypatch.setattr(Connection, "unread_s", 0.5)
    routes = [Route("/", hello, methods=["GET", "POST"]), Route("/endless", endless)]
    server = uvicorn.Server(configuration(Starlette(routes=routes)))
    listener = socket.create_server(("0.0.0.0", 0), backlog=256)  # noqa: S104  # to be reached by several addresses
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])))
    thread.start()
    yield listener.getsockname()[1]
    server.should_exit = True
    thread.join(60)
    listener.close()
    assert not thread.is_alive()


@pytest.fixture
def crowd(port: int) -> Iterator[Callable[[int, bytes], list[socket.socket]]]:
    made: list[socket.socket] = []

    def come(count: int, says: bytes, source: str = "127.0.0.1") -> list[socket.socket]:
        new = []
        for _ in range(count):
            one = socket.create_connection(("127.0.0.1", port), 10, (source, 0))
            one.sendall(says)
            new.append(one)
        made.extend(new)
        return new

    yield come
    for one in made:
        one.close()


def asked(port: int, source: str = "127.0.0.1") -> int:
    """The status of one request."""
    one = http.client.HTTPConnection("127.0.0.1", port, timeout=60, source_address=(source, 0))
    try:
        one.request("GET", "/")
        return one.getresponse().status
    finally:
        one.close()


def ended(one: socket.socket, within_s: float = 60.0) -> bool:
    """Whether the server ends a connection, whatever it says before."""
    one.settimeout(within_s)
    until = time.monotonic() + within_s
    try:
        while time.monotonic() < until:
            if not one.recv(1 << 20):
                return True
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return False


Crowd = Callable[..., list[socket.socket]]


@pytest.mark.parametrize("says", [b"", b"GET / HT", SLOW])
def test_silent_ones_lock_nobody_out(port: int, crowd: Crowd, says: bytes) -> None:
    for address in range(2, 9):  # more than are served, from several addresses
        crowd(connection.PER_ADDRESS, says, f"127.0.0.{address}")
    crowd(70, says)
    assert asked(port) == 200
    assert asked(port, "127.0.0.9") == 200


@pytest.mark.parametrize("says", [b"", b"GET / HT", SLOW, WHOLE, WHOLE + b"GET /"])
def test_who_does_not_ask_is_let_go(crowd: Crowd, says: bytes) -> None:
    (one,) = crowd(1, says)
    assert ended(one)


def test_one_address_has_its_share(port: int, crowd: Crowd) -> None:
    """Those that wait for an answer stay; one more from there is turned away, one from elsewhere is not."""
    held = crowd(connection.PER_ADDRESS, ENDLESS)
    for one in held:
        assert one.recv(12) == b"HTTP/1.1 200"
    (more,) = crowd(1, b"")
    assert ended(more)
    assert asked(port, "127.0.0.9") == 200


@pytest.mark.slow
def test_a_page_that_does_not_read_is_let_go(port: int, crowd: Crowd) -> None:
    """It comes to read only after the server has given it up: then the stream has an end."""
    held = crowd(connection.PER_ADDRESS, ENDLESS)
    until = time.monotonic() + 60
    while True:
        try:
            if asked(port) == 200:
                break
        except (ConnectionError, http.client.HTTPException):
            assert time.monotonic() < until, "never let go"
            threading.Event().wait(0.05)
    eventually(lambda: any(ended(one, 0.5) for one in held), "one of them has an end", 60)


@pytest.mark.parametrize(
    ("says", "reason"),
    [
        (b"nonsense\r\n\r\n", "a request that is not HTTP"),
        (
            b"GET / HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: websocket\r\n\r\n",
            "a request for another protocol than HTTP",
        ),
    ],
)
def test_requests_that_cant_be_read_are_one_line_of_the_log(
    crowd: Callable[[int, bytes], list[socket.socket]],
    says: bytes,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(Connection, "refusals", RefusalLog(logging.getLogger("test"), RecordedClock(10**18)))
    for _ in range(5):
        for one in crowd(8, says):
            assert one.recv(100).startswith(b"HTTP/1.1 ")
            one.close()
    assert caplog.messages == [f"127.0.0.1: refused: {reason}"]


def test_a_client_is_who_connects_not_who_it_says(port: int) -> None:
    one = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    one.request("GET", "/", headers={"X-Forwarded-For": "10.0.0.8", "X-Forwarded-Proto": "https"})
    assert one.getresponse().getheader("x-client") == "127.0.0.1"
    one.close()
