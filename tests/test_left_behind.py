"""What a test leaves behind is found at its own end."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading

import pytest

from tests import left_behind
from tests.left_behind import Watch


def test_threads_processes_and_sockets_are_found_and_those_of_wider_fixtures_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(left_behind, "GRACE_S", 0.05)
    watch, before, ends = Watch(), left_behind.held(), threading.Event()
    thread = threading.Thread(target=ends.wait, name="stays")
    thread.start()
    with socket.socket(), subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert sorted(kind for kind, _ in watch.left(before)) == ["process", "socket", "thread"]
        assert f"process {process.pid} " in left_behind.named(watch.left(before))
        process.communicate()
    assert [kind for kind, _ in watch.left(before)] == ["thread"]
    ends.set()
    thread.join()
    with watch.wider():
        kept = socket.socket()
    assert not watch.left(before)
    kept.close()
