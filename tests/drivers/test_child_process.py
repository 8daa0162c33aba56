"""What child processes do when their parent goes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path


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
