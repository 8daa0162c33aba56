"""How child processes begin, how they end, and what they do when their parent goes."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dappled.drivers.camera import CameraError
from dappled.drivers.child_process import ChannelError, ProcessChannel, RestartBudget, end_child, start_child
from dappled.drivers.wired.ptp_source import PtpSource


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_a_worker_that_a_thread_started_outlives_the_thread_but_not_the_process() -> None:
    child = (
        "import os, sys, time\n"
        "from dappled.drivers.child_process import end_with_parent\n"
        "end_with_parent(int(sys.argv[1]))\n"
        "print(os.getpid(), flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = (
        "import os, subprocess, sys, threading\n"
        f"begin = lambda: subprocess.Popen([sys.executable, '-c', {child!r}, str(os.getpid())])\n"
        "thread = threading.Thread(target=begin); thread.start(); thread.join()\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as started:
        assert started.stdout is not None
        pid = int(started.stdout.readline())
        assert lives(pid)
        started.kill()
        started.wait()
    deadline = time.monotonic() + 20
    while lives(pid):
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.01)


def started(code: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"here\n"
    return process


def test_a_child_that_ends_by_itself_is_not_killed() -> None:
    with started("import sys; print('here', flush=True); sys.exit(sys.stdin.read() != '')") as process:
        assert process.stdin is not None
        process.stdin.close()
        end_child(process, 20.0)
        assert process.returncode == 0


def test_a_child_that_does_not_end_is_killed() -> None:
    with started("import sys; print('here', flush=True); sys.stdin.read()") as process:
        process.send_signal(signal.SIGSTOP)  # it handles no signal but SIGKILL now
        end_child(process, 0.0)
        assert process.wait(20) == -signal.SIGKILL


def test_a_child_that_can_not_be_started_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs: list[tuple[ProcessChannel, socket.socket]] = []
    pair = ProcessChannel.pair

    def watched() -> tuple[ProcessChannel, socket.socket]:
        pairs.append(pair())
        return pairs[-1]

    def refuse(*_arguments: Any, **_options: Any) -> None:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(ProcessChannel, "pair", watched)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(OSError, match="temporarily unavailable"):
        start_child("dappled.drivers.wired.ptp_source", "usb:")
    with pytest.raises(CameraError, match=r"no process can be started for the camera at usb:.*try again"):
        PtpSource("usb:").list()
    assert len(pairs) == 2
    for near, far in pairs:
        assert far.fileno() == -1
        with pytest.raises(ChannelError):
            near.send({})


def test_the_restart_budget_allows_its_limit_in_any_window() -> None:
    budget = RestartBudget(limit=2, window_s=60.0)
    second = 1_000_000_000
    for at in (0, 10):
        assert budget.wait_ns(at * second) == 0
        budget.spend(at * second)
    assert budget.wait_ns(20 * second) == 40 * second
    assert budget.wait_ns(60 * second) == 0
    budget.spend(60 * second)
    assert budget.wait_ns(61 * second) == 9 * second


# --- messages


Ends = tuple[ProcessChannel, ProcessChannel]


@pytest.fixture
def ends() -> Iterator[Ends]:
    here, there = ProcessChannel.pair()
    other = ProcessChannel(there)
    yield here, other
    here.close()
    other.close()


def test_nothing_to_receive_is_none(ends: Ends) -> None:
    assert ends[0].receive(0.0) is None


def test_the_end_of_the_other_end_is_reported(ends: Ends) -> None:
    ends[1].close()
    with pytest.raises(ChannelError, match="ended"):
        ends[0].receive(5.0)
    with pytest.raises(ChannelError, match="gone"):
        ends[0].send({"do": "ping"})


def test_a_full_channel_does_not_block(ends: Ends) -> None:
    def fill() -> None:
        for number in range(100_000):
            ends[0].send({"do": "fire", "shot": number})

    with pytest.raises(ChannelError, match="no more"):
        fill()
