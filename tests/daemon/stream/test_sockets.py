"""Which endpoints are bound, and which are refused in words."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
import zmq

from dappled.daemon.stream import sockets
from dappled.daemon.stream.wire import WireError


@pytest.mark.parametrize("endpoint", ["tcp://0.0.0.0:5555", "tcp://192.0.2.1:5555", "tcp://*:5555"])
def test_tcp_off_loopback_is_refused_without_keys(endpoint: str) -> None:
    with pytest.raises(WireError, match="open to the network"):
        sockets.prepare(endpoint)


@pytest.mark.parametrize("endpoint", ["inproc://x", "ipc://relative", "ipc:///" + "x" * 200, "fish"])
def test_strange_endpoints_are_refused(endpoint: str) -> None:
    with pytest.raises(WireError):
        sockets.prepare(endpoint)


def test_a_file_is_not_taken_for_a_socket(tmp_path: Path) -> None:
    (tmp_path / "s").write_text("precious")
    with pytest.raises(WireError, match="not a socket"):
        sockets.prepare(f"ipc://{tmp_path}/s")
    assert (tmp_path / "s").read_text() == "precious"


def test_keys_open_the_network() -> None:
    sockets.prepare("tcp://0.0.0.0:5555", keyed=True)


@pytest.mark.parametrize(
    ("host", "here"), [("127.0.0.2", True), ("::1", True), ("localhost", True), ("10.0.0.1", False)]
)
def test_what_is_loopback(host: str, here: bool) -> None:
    assert sockets.is_loopback(host) is here


@pytest.mark.parametrize("mode", [0o600, 0o660])
def test_an_ipc_socket_has_the_mode_that_was_asked_for(tmp_path: Path, mode: int) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    one = context.socket(zmq.PUB)
    sockets.bind(one, f"ipc://{tmp_path}/s", mode=mode)
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == mode
    one.close(linger=0)
    context.term()
