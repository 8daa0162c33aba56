"""The daemon's side of the console: its socket, and a process that is kept running."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from dappled.clock import SystemClock
from dappled.config.settings import ConsoleSettings, PublishSettings, Settings
from dappled.daemon.console import process
from dappled.daemon.console.process import Console
from dappled.daemon.console.requests import ConsoleRequests
from dappled.drivers.child_process import RestartBudget
from dappled.errors import DappledError
from tests.waiting import eventually

TOKEN = "a-token-of-many-letters"  # noqa: S105  # it opens nothing


def token_file(folder: Path, text: str = TOKEN, mode: int = 0o600) -> str:
    path = folder / "token"
    path.write_text(text)
    path.chmod(mode)
    return str(path)


@pytest.mark.parametrize("bind", ["8080", "127.0.0.1", "127.0.0.1:x", ":8080", "127.0.0.1:99999", "127.0.0.1:-1"])
def test_an_address_that_is_none(bind: str) -> None:
    with pytest.raises(DappledError, match="must be host:port"):
        process.listen(ConsoleSettings(bind=bind))


@pytest.mark.parametrize("bind", ["0.0.0.0:0", "192.0.2.1:0", "[::]:0", "drone.lan:0"])
def test_beyond_loopback_a_token_is_needed(bind: str) -> None:
    with pytest.raises(DappledError, match="open to the network without a token"):
        process.listen(ConsoleSettings(bind=bind))


def test_with_a_token_it_opens_wider(tmp_path: Path) -> None:
    listener, token = process.listen(ConsoleSettings(bind="0.0.0.0:0", token=token_file(tmp_path)))
    with listener:
        assert token == TOKEN
        assert process.url(listener).startswith("http://127.0.0.1:")


def test_a_token_that_others_can_read_or_guess_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DappledError, match="chmod 600"):
        process.listen(ConsoleSettings(bind="127.0.0.1:0", token=token_file(tmp_path, mode=0o644)))
    with pytest.raises(DappledError, match="holds no token"):
        process.listen(ConsoleSettings(bind="127.0.0.1:0", token=token_file(tmp_path, "short")))
    with pytest.raises(DappledError, match="can't be read"):
        process.listen(ConsoleSettings(bind="127.0.0.1:0", token=str(tmp_path / "none")))


def test_a_port_that_is_taken_is_refused_in_words() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(DappledError, match="can't listen on"):
        process.listen(ConsoleSettings(bind=f"127.0.0.1:{taken.getsockname()[1]}"))


def test_loopback_of_ipv6_too() -> None:
    if not socket.has_ipv6 or not Path("/proc/net/if_inet6").exists():
        pytest.skip("this machine has no IPv6")
    listener, token = process.listen(ConsoleSettings(bind="[::1]:0"))
    with listener:
        assert (token, process.url(listener)[:13]) == ("", "http://[::1]:")


def test_without_a_bind_there_is_no_socket() -> None:
    with ExitStack() as stack:
        assert process.open_listener(Settings(), stack) is None


@pytest.mark.parametrize(("slices", "private"), [("ipc:///x/s", False), ("tcp://127.0.0.1:5555", True)])
def test_a_stream_over_tcp_gets_an_endpoint_of_the_daemon_s_own(slices: str, private: bool) -> None:
    settings = replace(Settings(), publish=PublishSettings(slices=slices), console=ConsoleSettings(bind="127.0.0.1:0"))
    with ExitStack() as stack:
        opened = process.open_listener(settings, stack)
        assert opened is not None
        assert opened.private.startswith("ipc://") is private


def setup(folder: Path) -> dict[str, Any]:
    return {"token": "", "hosts": [], "map": "", "area": "", "endpoint": f"ipc://{folder}/s", "ask": "", "recipe": None,
            "mount": [1, 0, 0, 0, 1, 0, 0, 0, 1], "run": "0000"}  # fmt: skip


def running(console: Console) -> subprocess.Popen[bytes] | None:
    return console.process


class Handler(ConsoleRequests):
    """Answers by a function of the test."""

    def __init__(self, act: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> None:
        self.answer = act  # type: ignore[method-assign, assignment]  # this test's


def test_a_console_that_dies_is_started_again_and_the_socket_stays(tmp_path: Path) -> None:
    asked: list[Mapping[str, Any]] = []

    def act(request: Mapping[str, Any]) -> Mapping[str, Any]:
        asked.append(request)
        return {"ok": True, "text": "shot 5"}

    listener, _ = process.listen(ConsoleSettings(bind="127.0.0.1:0"))
    url = process.url(listener)
    console = Console(listener, setup(tmp_path), Handler(act), SystemClock())
    console.start()
    try:
        with httpx.Client(base_url=url, timeout=60, headers={"origin": url.rstrip("/")}, trust_env=False) as client:
            assert client.post("/api/shoot", json={"sequence": 1}).json()["text"] == "shot 5"
            first = running(console)
            assert first is not None
            assert os.getpriority(os.PRIO_PROCESS, first.pid) >= min(19, os.getpriority(os.PRIO_PROCESS, 0) + 15)
            first.kill()
            until = time.monotonic() + 60
            while running(console) in (first, None):
                assert time.monotonic() < until
                threading.Event().wait(0.01)
        with httpx.Client(base_url=url, timeout=60, trust_env=False) as client:
            assert client.get("/api/state").json()["verdict"] is None  # nothing was heard of the daemon yet
    finally:
        console.stop()
    assert first.poll() is not None
    assert running(console) is None
    with pytest.raises(httpx.ConnectError):
        httpx.get(url, trust_env=False)


def test_a_console_that_keeps_dying_is_not_started_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    begun: list[int] = []

    def die(*_arguments: Any, **_options: Any) -> None:
        begun.append(1)
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    monkeypatch.setattr(subprocess, "Popen", die)
    listener, _ = process.listen(ConsoleSettings(bind="127.0.0.1:0"))
    console = Console(listener, setup(tmp_path), Handler(lambda _: {}), SystemClock(), RestartBudget(2, 3600.0))
    console.start()
    try:
        eventually(lambda: "too often; the next attempt is in 3600 s" in caplog.text, "it waits")
        assert len(begun) == 2
        assert console.dead_threads() == []
    finally:
        console.stop()


@pytest.mark.slow
def test_an_answer_that_fails_ends_one_process_and_not_the_console(tmp_path: Path) -> None:
    begun: list[int] = []

    def act(request: Mapping[str, Any]) -> Mapping[str, Any]:
        begun.append(1)
        if len(begun) == 1:
            raise RuntimeError("a fault of the daemon's own")
        return {"ok": True, "text": "shot 1"}

    listener, _ = process.listen(ConsoleSettings(bind="127.0.0.1:0"))
    url = process.url(listener)
    console = Console(listener, setup(tmp_path), Handler(act), SystemClock())
    console.start()
    try:
        until, answer = time.monotonic() + 60, None
        while answer != {"ok": True, "text": "shot 1"}:
            assert time.monotonic() < until
            with (  # the process that was asked first may still be ending: a new connection each time
                contextlib.suppress(httpx.HTTPError),
                httpx.Client(base_url=url, timeout=60, headers={"origin": url.rstrip("/")}, trust_env=False) as client,
            ):
                answer = client.post("/api/shoot", json={"sequence": 1}).json()
                answer = {key: answer.get(key) for key in ("ok", "text")}
        assert running(console) is not None
    finally:
        console.stop()
