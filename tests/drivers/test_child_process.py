"""How child processes begin, how they end, and what they do when their parent goes."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dappled.drivers.camera import CameraError
from dappled.drivers.child_process import (
    DECODER_GOES,
    VIEWERS_GO,
    ChannelError,
    MessageSizeError,
    ProcessChannel,
    RestartBudget,
    end_child,
    how_ended,
    start_child,
)
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
    deadline = time.monotonic() + 60
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
        assert process.wait(60) == -signal.SIGKILL


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


def test_a_child_lets_others_run_before_it_from_its_first_import_on() -> None:
    own, found = os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), []
    for niceness in (0, 3):
        process, channel = start_child("dappled.drivers.wired.ptp_source", "usb:", niceness=niceness)
        found.append(os.getpriority(os.PRIO_PROCESS, process.pid))
        end_child(process, 0.0)
        channel.close()
    assert found == [own, own + 3]


def test_looking_goes_before_decoding_and_decoding_before_the_rest() -> None:
    """From the child's first moment: what it imports alone can be too much."""
    own = int(Path("/proc/self/oom_score_adj").read_text(encoding="ascii"))
    scores = [own]
    for score in (DECODER_GOES, VIEWERS_GO):
        process, channel = start_child("dappled.drivers.wired.ptp_source", "usb:", goes_first=score)
        scores.append(int(Path(f"/proc/{process.pid}/oom_score_adj").read_text(encoding="ascii")))
        end_child(process, 0.0)
        channel.close()
    assert scores == [own, 500, 800]


def test_a_real_time_process_that_never_sleeps_is_ended_by_a_signal_that_tells_why() -> None:
    """At the hard limit the kernel sends SIGKILL, as for want of memory."""
    program = (
        "import resource; from dappled.drivers.child_process import raise_priority; raise_priority();"
        "print(*resource.getrlimit(resource.RLIMIT_RTTIME))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    soft, hard = map(int, done.stdout.split())
    assert soft == 1_000_000 < hard


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (-signal.SIGXCPU, "it used real-time CPU for 1 s without a pause"),
        (-signal.SIGSEGV, "killed: Segmentation fault"),
        (-signal.SIGRTMIN - 1, "killed: "),
        (3, "exit status 3"),
        (None, "the kernel holds it"),
    ],
)
def test_the_end_of_a_process_is_told_in_words(code: int | None, words: str) -> None:
    assert words in how_ended(code)


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


def test_a_message_that_is_too_long_is_not_sent_and_the_channel_goes_on(ends: Ends) -> None:
    with pytest.raises(MessageSizeError, match="longer than a message may be"):
        ends[0].send({"text": "x" * 200_000})
    ends[0].send({"text": "x" * 130_000})
    message = ends[1].receive(5.0)
    assert message is not None
    assert len(message.body["text"]) == 130_000


# --- descriptors run out, for real: in a process of their own, with a limit of their own

STARVED = """
import contextlib, os, resource, sys
from dappled.clock import RecordedClock
from dappled.drivers.camera import Blob
from dappled.drivers.child_process import ProcessChannel

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
clock = RecordedClock(10**12)
here, there = ProcessChannel.pair()
there = ProcessChannel(there, clock)
hogs = []

def exhaust(spare=0):
    with contextlib.suppress(OSError):
        while True:
            hogs.append(os.open(os.devnull, os.O_RDONLY))
    for _ in range(spare):
        os.close(hogs.pop())

def free():
    while hogs:
        os.close(hogs.pop())

def send(number, files):
    blobs = [Blob.of(f"frame {number}, file {file}".encode()) for file in range(files)]
    here.send({"number": number}, tuple(blob.fd for blob in blobs))
    for blob in blobs:
        blob.close()

def told(message):
    if message is None:
        return None
    found = [os.pread(fd, 100, 0).decode() for fd in message.fds]
    for fd in message.fds:
        os.close(fd)
    return message.body["number"], found, message.lost

def opened():
    return len(os.listdir("/proc/self/fd"))
"""


def starved(code: str) -> None:
    subprocess.run([sys.executable, "-c", STARVED + code], check=True, timeout=60)


@pytest.mark.parametrize("spare", [0, 1, 2, 8])
def test_a_file_stays_in_the_socket_until_there_are_descriptors_again(spare: int) -> None:
    """Also where there is room for it, and none for writing it to disk."""
    starved(
        "before = opened()\n"
        "send(1, 2)\n"
        "send(2, 0)\n"
        f"exhaust({spare})\n"
        "for _ in range(3):\n"
        "    assert there.receive(0.0) is None and there.starved\n"
        "    clock.advance(3.0)\n"
        "free()\n"
        "assert told(there.receive(5.0)) == (1, ['frame 1, file 0', 'frame 1, file 1'], '')\n"
        "assert not there.starved\n"
        "assert told(there.receive(5.0)) == (2, [], '')\n"
        "assert opened() == before\n"
    )


def test_a_shortage_that_lasts_costs_the_files_and_not_the_channel() -> None:
    starved(
        "send(1, 1)\n"
        "send(2, 0)\n"
        "send(3, 1)\n"
        "exhaust()\n"
        "assert there.receive(0.0) is None\n"
        "clock.advance(10.1)\n"
        "number, files, lost = told(there.receive(0.0))\n"
        "assert (number, files) == (1, [])\n"
        "assert 'run out of file descriptors (its limit is 64)' in lost, lost\n"
        "assert told(there.receive(0.0)) == (2, [], '')\n"
        "assert told(there.receive(0.0))[1:] == ([], lost)\n"  # the shortage goes on: it was waited for once
        "free()\n"
        "send(4, 1)\n"
        "assert told(there.receive(0.0)) == (4, ['frame 4, file 0'], '')\n"
        "send(5, 1)\n"
        "exhaust()\n"
        "assert there.receive(0.0) is None and there.starved\n"  # another shortage is waited for again
        "free()\n"
        "assert told(there.receive(0.0)) == (5, ['frame 5, file 0'], '')\n"
    )


def test_descriptors_that_come_back_while_it_waits_are_used_at_once() -> None:
    starved(
        "import threading, time\n"
        "there = ProcessChannel(there._socket)\n"
        "send(1, 1)\n"
        "threading.Thread(target=lambda: (time.sleep(0.3), free())).start()\n"
        "exhaust()\n"
        "began = time.monotonic()\n"
        "assert told(there.receive(60.0)) == (1, ['frame 1, file 0'], '')\n"
        "assert time.monotonic() - began < 30\n"
    )
