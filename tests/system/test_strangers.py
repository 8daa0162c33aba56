"""Strangers who open TCP connections and say nothing cost no photograph, no acknowledgement and no viewer."""

from __future__ import annotations

import contextlib
import http.client
import math
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from dappled.daemon.camera_protocol.ground_client import GroundClient
from dappled.daemon.stream import curve
from dappled.daemon.stream.curve import ClientKeys
from dappled.daemon.stream.subscriber import Subscriber
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.mocks.simulation import free_port

ACK_MS = 50.0
LATE_MS = 1000.0  # for one acknowledgement in 20, on a machine whose cores are all busy
PICTURE_BYTES = 100_001
ADDRESSES = 4  # of the strangers: 127.0.0.2, …


@dataclass(frozen=True)
class OpenDaemon:
    """A daemon in a process of its own, with its stream and its console on TCP."""

    process: subprocess.Popen[str]
    mavlink: str
    stream: int
    ask: int
    console: int
    keys: ClientKeys


@contextlib.contextmanager
def daemon(folder: Path, descriptors: int) -> Iterator[OpenDaemon]:
    """The daemon as the service runs it, in front of a simulated body, with `descriptors` as its limit."""
    curve.make(folder, "vehicle")
    curve.make(folder / "clients", "laptop")
    link, stream, ask, console = (free_port(), *(free_port(socket.SOCK_STREAM) for _ in range(3)))
    with SimulatedBody.start(BodyOptions(picture=f"pattern:{PICTURE_BYTES}:cr2")) as body:
        (folder / "dappled.toml").write_text(
            f'[camera]\nport = "{body.port}"\n[mavlink]\nurl = "udpin:127.0.0.1:{link}"\n'
            '[record]\ndirectory = "flights"\nmin_free_mb = 0\n[pose]\nwait_ms = 0\n'
            f'[publish]\nslices = "tcp://127.0.0.1:{stream}"\nask = "tcp://127.0.0.1:{ask}"\n'
            f'keys = "vehicle.key_secret"\nclients = "clients"\n[console]\nbind = "127.0.0.1:{console}"\n'
        )
        run = ["prlimit", f"--nofile={descriptors}", sys.executable, "-m", "dappled", "run", "--config", "dappled.toml"]
        with (folder / "stderr").open("w") as errors:
            process = subprocess.Popen(run, cwd=folder, stdout=subprocess.DEVNULL, stderr=errors, text=True)
        try:
            keys = ClientKeys(
                curve.load_own(folder / "clients" / "laptop.key_secret"), curve.load_public(folder / "vehicle.key")
            )
            yield OpenDaemon(process, f"udpout:127.0.0.1:{link}", stream, ask, console, keys)
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(60)
            finally:
                process.kill()


@contextlib.contextmanager
def strangers(count: int, ports: list[int]) -> Iterator[list[socket.socket]]:
    """So many connections over these ports, from a few addresses, which say nothing."""
    made: list[socket.socket] = []
    try:
        for number in range(count):
            one = socket.socket()
            one.setblocking(False)
            one.bind((f"127.0.0.{2 + number % ADDRESSES}", 0))
            with contextlib.suppress(BlockingIOError):
                one.connect(("127.0.0.1", ports[number % len(ports)]))
            made.append(one)
        yield made
    finally:
        for one in made:
            one.close()


def until_answers(port: int) -> None:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 10):
            return
    pytest.fail(f"no program listens on port {port}")


def requests_page(port: int) -> int:
    page = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    page.request("GET", "/")
    try:
        return page.getresponse().status
    finally:
        page.close()


@pytest.mark.parametrize(
    ("descriptors", "count", "requests", "timed"),
    [
        pytest.param(256, 400, 8, False, marks=pytest.mark.slow),
        pytest.param(4096, 5000, 60, True, marks=[pytest.mark.long, pytest.mark.alone]),
    ],
)
def test_silent_strangers_cost_no_photograph_and_no_viewer(
    tmp_path: Path, descriptors: int, count: int, requests: int, timed: bool
) -> None:
    with daemon(tmp_path, descriptors) as one, GroundClient(one.mavlink) as ground:
        ground.find_camera(30)
        for port in (one.stream, one.ask, one.console):
            until_answers(port)
        stream, ask = (f"tcp://127.0.0.1:{port}" for port in (one.stream, one.ask))
        with (
            strangers(count, [one.stream, one.ask, one.console]),
            Subscriber(stream, ask, keys=one.keys) as viewer,
        ):
            outcomes = ground.capture(requests, timeout_s=60)
            assert [each.reason for each in outcomes if not each.ok] == []
            acks = sorted(math.inf if each.ack_ms is None else each.ack_ms for each in outcomes)
            print(f"{count} strangers: acknowledgements up to {acks[-1]:.1f} ms, median {acks[len(acks) // 2]:.1f} ms")  # noqa: T201  for people who run with -s
            assert acks[-1] < math.inf  # each one comes
            if timed:
                assert acks[-1] <= LATE_MS
                assert acks[-1 - requests // 20] <= ACK_MS  # one in 20 may wait for other programs of this machine
            until = time.monotonic() + 60
            while (message := viewer.receive(1)) is None or message.topic != "frame":
                assert time.monotonic() < until
                ground.capture(1, timeout_s=60)  # the first ones may have been sent before the viewer was let in
            viewer.ask({"get": "frame", "frame": 0})
            while (message := viewer.receive(1)) is None or message.header.get("asked") is None:
                assert time.monotonic() < until
            assert requests_page(one.console) == 200
        assert one.process.poll() is None
    assert one.process.returncode == 0, (tmp_path / "stderr").read_text()
