"""Processes beside a channel: how they begin and how they end."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from typing import Any

import pytest

from dappled.drivers.camera import CameraError
from dappled.drivers.gphoto2 import spawn
from dappled.drivers.gphoto2.channel import Channel, ChannelError
from dappled.drivers.wired.ptp_source import PtpSource


def started(code: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"here\n"
    return process


def test_one_that_ends_by_itself_is_let() -> None:
    with started("import sys; print('here', flush=True); sys.exit(sys.stdin.read() != '')") as process:
        assert process.stdin is not None
        process.stdin.close()
        spawn.end(process, 20.0)
        assert process.returncode == 0


def test_one_that_does_not_is_killed() -> None:
    with started("import sys; print('here', flush=True); sys.stdin.read()") as process:
        process.send_signal(signal.SIGSTOP)  # as deaf as can be
        spawn.end(process, 0.0)
        assert process.wait(20) == -signal.SIGKILL


def test_one_that_can_not_be_started_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs: list[tuple[Channel, socket.socket]] = []
    pair = Channel.pair

    def watched() -> tuple[Channel, socket.socket]:
        pairs.append(pair())
        return pairs[-1]

    def refuse(*_arguments: Any, **_options: Any) -> None:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(Channel, "pair", watched)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(OSError, match="temporarily unavailable"):
        spawn.spawn("dappled.drivers.wired.ptp_source", "usb:")
    with pytest.raises(CameraError, match=r"no process can be started for the camera at usb:.*try again"):
        PtpSource("usb:").list()
    assert len(pairs) == 2
    for near, far in pairs:
        assert far.fileno() == -1
        with pytest.raises(ChannelError):
            near.send({})
