"""The journal's native protocol, read back by its rules."""

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

from dappled.daemon.health import log_format

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
    assert read(log_format.entry(told)) == whole


def test_a_record_keeps_its_words_and_its_facts(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        handler = log_format.JournalHandler(str(tmp_path / "j"))
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
        handler = log_format.JournalHandler(str(tmp_path / "j"))
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
    told = log_format.fields(record)
    assert told["MESSAGE"] == "it failed"
    assert "ValueError: invalid literal" in told["DAPPLED_TRACEBACK"]


def test_stderr_takes_the_log_where_it_is_not_the_journals(tmp_path: Path) -> None:
    about = os.fstat(2)
    ours = {"JOURNAL_STREAM": f"{about.st_dev}:{about.st_ino}"}
    nowhere = str(tmp_path / "no journal")
    assert isinstance(log_format.handler({}, nowhere), logging.StreamHandler)
    assert isinstance(log_format.handler({"JOURNAL_STREAM": "1:2"}, nowhere), logging.StreamHandler)
    assert isinstance(log_format.handler(ours, nowhere), logging.StreamHandler)  # named, but not there
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        chosen = log_format.handler(ours, str(tmp_path / "j"))
        assert isinstance(chosen, log_format.JournalHandler)
        chosen.close()
