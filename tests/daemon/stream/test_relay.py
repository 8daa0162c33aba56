"""Viewers over TCP: through the process that listens for them, and again after it was killed."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time

import pytest

from dappled.clock import SystemClock
from dappled.daemon.stream.publisher import Publisher
from dappled.daemon.stream.relay import TcpRelay
from dappled.daemon.stream.subscriber import Subscriber
from dappled.daemon.stream.wire import Message, WireError
from dappled.mocks.simulation import free_port
from dappled.refusals import RefusalLog
from tests.waiting import eventually


def test_a_killed_relay_costs_viewers_a_moment_and_the_publisher_nothing() -> None:
    endpoint, ask = (f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2))
    one = Publisher(endpoint, ask)
    one.start("f", lambda request, reply: reply(Message("frame", dict(request))))
    relay = one._sockets._relay._process
    assert relay is not None
    try:
        with Subscriber(endpoint, ask) as viewer:

            def sees() -> bool:
                one.publish("frame", {"frame": 1})
                return viewer.receive(0.05) is not None

            eventually(sees, "a first frame")
            assert relay.process is not None
            first = relay.process.pid
            os.kill(first, signal.SIGKILL)
            eventually(lambda: relay.process is not None and relay.process.pid != first, "another process")
            until = time.monotonic() + 0.2
            while time.monotonic() < until:  # what the dead one had passed on already
                viewer.receive(0.01)
            eventually(sees, "a frame through the new one")
            viewer.ask({"get": "frame", "frame": 7})
            eventually(lambda: (got := viewer.receive(0.5)) is not None and got.header["frame"] == 7, "an answer")
        assert one.statistics().dropped["frame"] == 0
        assert one.dead_threads() == []
    finally:
        one.stop(0.2)
    assert relay.process is None


def test_the_last_message_arrives_when_the_publisher_ends() -> None:
    endpoint = f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    one = Publisher(endpoint, "")
    one.start("f", lambda _, reply: reply(Message("error", {"error": "x"})))
    with Subscriber(endpoint) as viewer:

        def sees() -> bool:
            one.publish("frame", {"frame": 1})
            return viewer.receive(0.05) is not None

        eventually(sees, "a first frame")
        body = bytes(5_000_000)
        one.publish("slices", {"frame": 2, "arrays": []}, body)
        one.publish("end", {})
        one.stop()
        topics: list[str] = []
        while topics[-1:] != ["end"] and (message := viewer.receive(60)) is not None:
            topics.append(message.topic)
        assert topics[-2:] == ["slices", "end"]
    with socket.socket() as again:  # the port is free
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))


@pytest.mark.parametrize("endpoint", ["tcp://127.0.0.1", "tcp://127.0.0.1:x", "tcp://:5555", "tcp://127.0.0.1:70000"])
def test_an_endpoint_without_host_and_port_is_refused(endpoint: str) -> None:
    with pytest.raises(WireError, match="must be tcp://HOST:PORT"):
        TcpRelay(RefusalLog(logging.getLogger()), SystemClock()).listen(endpoint)
