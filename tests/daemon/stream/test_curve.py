"""Keys: on disk with the right modes, and over real CURVE sockets with the right people."""

from __future__ import annotations

import socket
import stat
import threading
import time
from pathlib import Path

import pytest
import zmq.auth
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import SystemClock
from dappled.daemon.stream import curve
from dappled.daemon.stream.curve import ClientKeys, ServerKeys
from dappled.daemon.stream.publisher import Publisher
from dappled.daemon.stream.sockets import Sockets
from dappled.daemon.stream.subscriber import Subscriber
from dappled.daemon.stream.wire import Message
from dappled.errors import DappledError
from dappled.mocks.simulation import free_port


@pytest.fixture
def keys(tmp_path: Path) -> tuple[ServerKeys, ClientKeys, ClientKeys]:
    """A vehicle's keys, those of a friend on its list, and a stranger's."""
    curve.make(tmp_path, "vehicle")
    curve.make(tmp_path / "allowed", "friend")
    curve.make(tmp_path, "stranger")
    made = curve.server(str(tmp_path / "vehicle.key_secret"), str(tmp_path / "allowed"))
    assert made is not None
    public = curve.load_public(tmp_path / "vehicle.key")
    friend = curve.load_own(tmp_path / "allowed" / "friend.key_secret")
    return made, ClientKeys(friend, public), ClientKeys(curve.load_own(tmp_path / "stranger.key_secret"), public)


def test_files_are_zeromq_s_own_and_only_their_owner_reads_the_secret(tmp_path: Path) -> None:
    public, secret = curve.make(tmp_path / "new", "vehicle")
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert stat.S_IMODE(public.stat().st_mode) == 0o644
    own = curve.load_own(secret)
    assert zmq.auth.load_certificate(str(secret)) == (own.public, own.secret)
    assert zmq.auth.load_certificate(str(public)) == (own.public, None)
    with pytest.raises(DappledError, match="exists already"):
        curve.make(tmp_path / "new", "vehicle")


def test_pyzmq_s_own_files_are_read(tmp_path: Path) -> None:
    _, secret = zmq.auth.create_certificates(str(tmp_path), "theirs")
    Path(secret).chmod(0o600)
    assert curve.load_own(Path(secret)).public == curve.load_public(tmp_path / "theirs.key")


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "x" * 65, "with space"])
def test_strange_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DappledError, match="be the name of a key"):
        curve.make(tmp_path, name)


def test_a_secret_that_others_can_read_is_refused(tmp_path: Path) -> None:
    _, secret = curve.make(tmp_path, "vehicle")
    secret.chmod(0o640)
    with pytest.raises(DappledError, match="chmod 600"):
        curve.load_own(secret)


def test_a_list_that_anybody_can_add_to_is_refused(tmp_path: Path) -> None:
    curve.make(tmp_path / "allowed", "friend")
    (tmp_path / "allowed").chmod(0o777)
    with pytest.raises(DappledError, match="can be written by any user"):
        curve.load_allowed(tmp_path / "allowed")


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    assert curve.server("", "") is None
    with pytest.raises(DappledError, match="go together"):
        curve.server("x", "")
    with pytest.raises(DappledError, match="can't be read"):
        curve.load_own(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DappledError, match="put the public key of each subscriber there"):
        curve.load_allowed(tmp_path / "empty")


@given(st.text(st.characters(max_codepoint=0x7F), max_size=60))
def test_any_file_is_a_key_or_an_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.key"
    path.write_text(f'curve\n    public-key = "{text}"\n', encoding="ascii", newline="")
    try:
        key = curve.load_public(path)
    except DappledError:
        return
    assert key == text.encode()


def test_only_those_on_the_list_get_in(keys: tuple[ServerKeys, ClientKeys, ClientKeys]) -> None:
    server, friend, stranger = keys
    endpoint, ask = (f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2))
    one = Publisher(endpoint, ask, sockets=Sockets(server, 0o660, SystemClock()))
    one.start("f", lambda _, reply: reply(Message("error", {"error": "x"})))
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.02):
            one.publish("frame", {"frame": 1})

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with (
            Subscriber(endpoint, ask, keys=friend) as welcome,
            Subscriber(endpoint, ask, keys=stranger) as unknown,
            Subscriber(endpoint, ask) as bare,
        ):
            message = welcome.receive(20)
            assert message is not None
            assert message.header["frame"] == 1
            welcome.ask({"get": "frame", "frame": 0})
            deadline = time.monotonic() + 60
            while (got := welcome.receive(5)) is not None and got.topic != "error":
                assert time.monotonic() < deadline
            while not one.statistics().wrong_keys:
                assert time.monotonic() < deadline
                assert unknown.receive(0.05) is None
            assert bare.receive(0.05) is None
    finally:
        stop.set()
        sender.join()
        one.stop(0.2)


def test_the_daemon_s_own_door_needs_no_key(keys: tuple[ServerKeys, ClientKeys, ClientKeys], tmp_path: Path) -> None:
    private = f"ipc://{tmp_path}/own"
    sockets = Sockets(keys[0], 0o660, SystemClock())
    one = Publisher(f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}", "", sockets=sockets, private=private)
    one.start("f", lambda request, reply: reply(Message("frame", dict(request))))
    with Subscriber(private, f"{private}.ask", topics=[]) as subscriber:
        subscriber.ask({"get": "frame", "frame": 5})
        message = subscriber.receive(20)
        assert message is not None
        assert message.header["frame"] == 5
    one.stop(0.2)
    assert not (tmp_path / "own").exists()
