"""The journal's native protocol, read back by its rules; and the notifications of a main loop."""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.health import systemd
from dappled.daemon.health.systemd import Notifier

S = 1_000_000_000
NAMES = st.from_regex(r"\A[A-Z][A-Z0-9_]{0,20}\Z")


def read(data: bytes) -> dict[str, str]:
    """Fields of one entry, as systemd documents it."""
    told: dict[str, str] = {}
    while data:
        line, _, rest = data.partition(b"\n")
        if b"=" in line:
            name, _, value = line.partition(b"=")
            data = rest
        else:
            (length,) = struct.unpack("<Q", rest[:8])
            name, value, data = line, rest[8 : 8 + length], rest[9 + length :]
            assert rest[8 + length : 9 + length] == b"\n"
        told[name.decode()] = value.decode()
    return told


@given(st.dictionaries(NAMES, st.text()))
def test_every_value_comes_back(told: dict[str, str]) -> None:
    whole = {name: value.encode("utf-8", "replace").decode() for name, value in told.items()}
    assert read(systemd.entry(told)) == whole


def test_a_record_keeps_its_words_and_its_facts(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        handler = systemd.JournalHandler(str(tmp_path / "j"))
        record = logging.LogRecord(
            "dappled.daemon.pipeline.pipeline", logging.WARNING, "f.py", 7, "frame %d is late", (42,), None
        )
        record.dappled = {"frame": 42, "a b": "two\nlines"}
        handler.emit(record)
        handler.close()
        told = read(listener.recv(10_000))
    assert told["MESSAGE"] == "frame 42 is late"
    assert told["PRIORITY"] == "4"
    assert told["DAPPLED_PART"] == "daemon.pipeline.pipeline"
    assert told["DAPPLED_FRAME"] == "42"
    assert told["DAPPLED_A_B"] == "two\nlines"


def test_whoever_logs_is_not_harmed_by_a_journal_that_stands_still_or_words_that_do_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unheard: list[logging.LogRecord] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        handler = systemd.JournalHandler(str(tmp_path / "j"))
        monkeypatch.setattr(handler, "handleError", unheard.append)
        handler.emit(logging.LogRecord("x", logging.ERROR, "f.py", 1, "%d frames", ("many",), None))
        assert len(unheard) == 1
        full = logging.LogRecord("x", logging.ERROR, "f.py", 1, "again", (), None)
        for _ in range(100_000):  # nobody reads: the socket's queue is full soon
            handler.emit(full)
            if len(unheard) == 2:
                break
        handler.close()
    assert len(unheard) == 2


def test_a_traceback_stands_in_a_field_of_its_own() -> None:
    try:
        int("bad")
    except ValueError:
        record = logging.LogRecord("x", logging.ERROR, "f.py", 1, "it failed", (), sys.exc_info())
    told = systemd.fields(record)
    assert told["MESSAGE"] == "it failed"
    assert "ValueError: invalid literal" in told["DAPPLED_TRACEBACK"]


def test_stderr_takes_the_log_where_it_is_not_the_journals(tmp_path: Path) -> None:
    about = os.fstat(2)
    ours = {"JOURNAL_STREAM": f"{about.st_dev}:{about.st_ino}"}
    nowhere = str(tmp_path / "no journal")
    assert isinstance(systemd.handler({}, nowhere), logging.StreamHandler)
    assert isinstance(systemd.handler({"JOURNAL_STREAM": "1:2"}, nowhere), logging.StreamHandler)
    assert isinstance(systemd.handler(ours, nowhere), logging.StreamHandler)  # named, but not there
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        chosen = systemd.handler(ours, str(tmp_path / "j"))
        assert isinstance(chosen, systemd.JournalHandler)
        chosen.close()


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


def test_the_watchdog_is_fed_ten_times_in_its_time(manager: socket.socket) -> None:
    with manager:
        notifier = Notifier(environment(manager, WATCHDOG_USEC="10000000"))
        notifier.ready(0)
        for turn in range(9):
            notifier.working(turn * S // 4)
        assert heard(manager) == ["READY=1", "WATCHDOG=1", "WATCHDOG=1"]  # at 1 s and at 2 s


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
