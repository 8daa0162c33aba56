"""What was written before the flusher's end is on the disk at its end."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from dappled.flight.flusher import Flusher

DEADLINE_S = 20.0


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
        assert flusher._closing.wait(DEADLINE_S)  # from here on `close` only waits
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
