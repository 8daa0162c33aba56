"""systemd is told what it asked to be told, by a working loop and not by a timer."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from dappled.daemon.health.notify import Notifier

S = 1_000_000_000


@pytest.fixture
def manager(tmp_path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(str(tmp_path / "n"))
    listener.settimeout(0.01)
    return listener


def heard(manager: socket.socket) -> list[str]:
    told = []
    try:
        while True:
            told.append(manager.recv(4096).decode())
    except TimeoutError:
        return told


def environment(manager: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": manager.getsockname(), **more}


def test_the_watchdog_is_fed_at_half_its_time(manager: socket.socket) -> None:
    with manager:
        notifier = Notifier(environment(manager, WATCHDOG_USEC="10000000"))
        notifier.ready(0)
        for turn in range(13):
            notifier.working(turn * S)
        assert heard(manager) == ["READY=1", "WATCHDOG=1", "WATCHDOG=1"]  # at 5 s and at 10 s


def test_a_loop_that_hangs_feeds_nothing(manager: socket.socket) -> None:
    with manager:
        notifier = Notifier(environment(manager, WATCHDOG_USEC="10000000"))
        notifier.working(5 * S)
        assert heard(manager) == ["WATCHDOG=1"]
        assert heard(manager) == []  # nothing but a turn of the loop feeds it


def test_a_watchdog_of_another_process_is_not_ours(manager: socket.socket) -> None:
    with manager:
        notifier = Notifier(environment(manager, WATCHDOG_USEC="10000000", WATCHDOG_PID=str(os.getpid() + 1)))
        notifier.working(100 * S)
        assert heard(manager) == []


def test_a_status_is_told_once_and_on_one_line(manager: socket.socket) -> None:
    with manager:
        notifier = Notifier(environment(manager))
        for text in ("camera ready", "camera ready", "camera\nabsent"):
            notifier.status(text)
        notifier.reloading(7_000)
        notifier.stopping()
        assert heard(manager) == [
            "STATUS=camera ready",
            "STATUS=camera absent",
            "RELOADING=1\nMONOTONIC_USEC=7",
            "STOPPING=1",
        ]


def test_an_abstract_address_is_understood() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        name = f"dappled-test-{os.getpid()}"
        listener.bind("\0" + name)
        Notifier({"NOTIFY_SOCKET": "@" + name}).ready(0)
        assert listener.recv(100) == b"READY=1"


def test_nobody_to_tell_is_no_error(tmp_path: Path) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "1"}):
        notifier = Notifier(environment)
        notifier.ready(0)
        notifier.working(S)
        notifier.status("x")
        notifier.stopping()
