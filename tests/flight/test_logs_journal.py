from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import SystemClock
from dappled.findings import Code, text
from dappled.flight import Cause, FlightError, Shot, log_reading, logs
from dappled.flight.logs import Flusher
from tests.flight.makers import shot, words_of

DEADLINE_S = 20.0
SHOTS = st.builds(
    Shot,
    st.integers(0, 2**31),
    st.builds(Cause, st.text(), st.text(), st.none() | st.integers(0, 2**31)),
    st.integers(0, 2**63 - 1),
    st.integers(0, 2**63 - 1),
)


@given(st.lists(SHOTS, max_size=5, unique_by=lambda shot: shot.index), st.binary(max_size=40))
def test_shots_come_back_and_a_torn_end_is_reported(
    tmp_path_factory: pytest.TempPathFactory, shots: list[Shot], torn: bytes
) -> None:
    path = tmp_path_factory.mktemp("journal") / "shots.jsonl"
    journal = logs.ShotJournal(path)
    for each in shots:
        journal.note(each)
    journal.close()
    assert log_reading.read_journal(path) == log_reading.JournalContents(tuple(shots), ())

    torn = torn.replace(b"\n", b"")
    with path.open("ab") as file:
        file.write(torn)
    found = log_reading.read_journal(path)
    assert found.shots == tuple(shots)
    assert len(found.problems) == (1 if torn else 0)

    again = logs.ShotJournal(path)  # closes the torn line off
    new = shot(2**31 + 1)
    again.note(new)
    again.close()
    assert log_reading.read_journal(path).shots == (*shots, new)


@given(st.binary(max_size=300))
def test_any_bytes_are_read_without_a_crash(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("journal") / "shots.jsonl"
    path.write_bytes(data)
    found = log_reading.read_journal(path)
    lines = data.split(b"\n")
    assert len(found.shots) + len(found.problems) == len(lines) - (lines[-1] == b"")


@pytest.mark.parametrize(
    "line",
    [
        b"[]",
        b'{"cause":{},"index":1}',
        b'{"cause":{"kind":"a","sequence":null,"source":"b"},"index":"1","wished_monotonic_ns":1,"wished_utc_ns":1}',
        b'{"cause":{"kind":"a","sequence":null,"source":"b"},"index":-1,"wished_monotonic_ns":1,"wished_utc_ns":1}',
        b'{"cause":{"kind":"a","sequence":true,"source":"b"},"index":1,"wished_monotonic_ns":1,"wished_utc_ns":1}',
        b"[" * 100_000,
    ],
)
def test_a_line_that_is_not_a_shot_is_reported(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "shots.jsonl"
    path.write_bytes(line + b"\n")
    found = log_reading.read_journal(path)
    assert (found.shots, words_of(found.problems)) == ((), (f"line 1 of {path} is not a shot",))


@pytest.mark.parametrize("index", ["9" * 26, "9" * 5000, "[" * 100_000])
def test_a_number_beyond_64_bits_is_no_shot(tmp_path: Path, index: str) -> None:
    path = tmp_path / "shots.jsonl"
    line = '{"cause":{"kind":"k","sequence":null,"source":"s"},"index":%s,"wished_monotonic_ns":1,"wished_utc_ns":1}\n'
    path.write_text(line % "7" + line % index)
    found = log_reading.read_journal(path)
    assert [shot.index for shot in found.shots] == [7]
    assert words_of(found.problems) == (f"line 2 of {path} is not a shot",)


def test_a_shot_noted_twice_is_told(tmp_path: Path) -> None:
    path = tmp_path / "shots.jsonl"
    journal = logs.ShotJournal(path)
    journal.note(shot(1))
    journal.note(shot(1))
    journal.close()
    found = log_reading.read_journal(path)
    assert (found.shots, words_of(found.problems)) == ((shot(1),), (f"line 2 of {path} notes shot 1 again",))


def test_no_journal_is_an_empty_one(tmp_path: Path) -> None:
    assert log_reading.read_journal(tmp_path / "missing") == log_reading.JournalContents((), ())
    with pytest.raises(FlightError, match="is a folder"):
        log_reading.read_journal(tmp_path)


class WaitsNoted(SystemClock):
    """Notes for how long somebody waited."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float | None] = []

    def pause(self, event: threading.Event, timeout_s: float | None) -> bool:
        self.waits.append(timeout_s)
        return super().pause(event, timeout_s)


def test_a_note_is_one_write_and_reaches_the_disk_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writes: list[bytes] = []
    flushed = threading.Event()
    write, fdatasync = os.write, os.fdatasync

    def watched_write(fd: int, data: bytes) -> int:
        writes.append(bytes(data))
        return write(fd, data)

    def watched_fdatasync(fd: int) -> None:
        fdatasync(fd)
        flushed.set()

    monkeypatch.setattr(os, "write", watched_write)
    monkeypatch.setattr(os, "fdatasync", watched_fdatasync)
    clock = WaitsNoted()
    journal = logs.ShotJournal(tmp_path / "shots.jsonl", clock=clock)
    journal.note(shot(3))
    assert len(writes) == 1
    assert writes[0].endswith(b"\n")
    assert flushed.wait(60)
    assert not any(clock.waits)  # a power cut may follow at once
    assert journal.problem is None
    journal.close()


@pytest.mark.parametrize("fault", ["ENOSPC", "short"])
def test_a_note_that_the_disk_refuses_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    write = os.write

    def refuse(fd: int, data: bytes) -> int:
        if fault == "short":
            return write(fd, data[:5])
        raise OSError(errno.ENOSPC, "full")

    journal = logs.ShotJournal(tmp_path / "shots.jsonl")
    monkeypatch.setattr(os, "write", refuse)
    with pytest.raises(FlightError, match=r"cannot note shot 3 in .*disk"):
        journal.note(shot(3))
    monkeypatch.undo()
    journal.note(shot(4))
    journal.close()
    assert log_reading.read_journal(tmp_path / "shots.jsonl").shots == (shot(4),)


def test_what_is_noted_after_the_end_gets_into_no_other_file(tmp_path: Path) -> None:
    journal = logs.ShotJournal(tmp_path / "shots.jsonl")
    journal.close()
    journal.close()
    told = r"cannot note shot 3 in .*shots\.jsonl: the flight is closed"
    with (tmp_path / "other").open("wb"), pytest.raises(FlightError, match=told):  # it is given the same descriptor
        journal.note(shot(3))
    assert (tmp_path / "other").read_bytes() == (tmp_path / "shots.jsonl").read_bytes() == b""


def test_a_flush_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.EIO, "io")

    journal = logs.ShotJournal(tmp_path / "shots.jsonl")
    monkeypatch.setattr(os, "fdatasync", refuse)
    journal.note(shot(3))
    journal.close()
    assert journal.problem is not None
    assert journal.problem.code is Code.LOG_UNWRITTEN
    assert "input/output error" in str(text(journal.problem))


def test_a_note_survives_the_process(tmp_path: Path) -> None:
    path = tmp_path / "shots.jsonl"
    code = (
        "import os, sys; from pathlib import Path; from dappled.flight.logs import ShotJournal;"
        "from tests.flight.makers import shot;"
        f"ShotJournal(Path({str(path)!r}), 60.0).note(shot(5)); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False, timeout=60)
    assert done.returncode == -9
    assert log_reading.read_journal(path).shots == (shot(5),)


def test_bytes_written_while_the_disk_was_busy_are_synced_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is slow: before its first sync is done more is written, and the flusher is told to end."""
    sizes: list[int] = []
    begun, go_on = threading.Event(), threading.Event()

    def slow(fd: int) -> None:
        sizes.append(os.fstat(fd).st_size)
        begun.set()
        assert go_on.wait(DEADLINE_S)

    monkeypatch.setattr(os, "fdatasync", slow)
    with (tmp_path / "log").open("ab", buffering=0) as file:
        flusher = Flusher(file.fileno(), interval_s=0.0)
        file.write(b"0123456789")
        flusher.poke()
        assert begun.wait(DEADLINE_S)
        file.write(b"0123456789")
        flusher.poke()
        end = threading.Thread(target=flusher.close)
        end.start()
        assert flusher._loop.stopping.wait(DEADLINE_S)  # from here on `close` only waits
        go_on.set()
        end.join(DEADLINE_S)
        assert not end.is_alive()
    assert sizes[-1] == 20
    assert flusher.error is None


def test_a_refused_sync_stays_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(fd: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", refuse)
    with (tmp_path / "log").open("ab", buffering=0) as file:
        flusher = Flusher(file.fileno())
        flusher.poke()
        flusher.close()
    assert flusher.error is not None
