from __future__ import annotations

import errno
import hashlib
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from dappled.flight import durable
from dappled.flight.durable import Flusher
from tests.flight.makers import held

DEADLINE_S = 20.0


def test_bytes_come_in_with_their_hash(tmp_path: Path) -> None:
    data = os.urandom(9_000_001)  # more than two chunks
    with held(data) as blob:
        assert durable.copy_in(blob.fd, blob.size, tmp_path / "a") == hashlib.sha256(data).hexdigest()
    assert (tmp_path / "a").read_bytes() == data
    assert os.listdir(tmp_path) == ["a"]
    assert durable.hash_file(tmp_path / "a") == hashlib.sha256(data).hexdigest()


def test_a_source_that_ends_early_leaves_nothing(tmp_path: Path) -> None:
    with held(b"abc", size=4) as blob, pytest.raises(EOFError, match="only 3 of 4 bytes"):
        durable.copy_in(blob.fd, blob.size, tmp_path / "a")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("call", ["sendfile", "fsync", "rename"])
def test_a_fault_before_the_rename_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    with held(b"abc") as blob:
        monkeypatch.setattr(os, call, refuse)
        with pytest.raises(OSError, match="no space"):
            durable.copy_in(blob.fd, blob.size, tmp_path / "a")
        monkeypatch.undo()
    assert os.listdir(tmp_path) == []


def test_the_order_is_file_then_name_then_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    fsync, rename = os.fsync, os.rename

    def watched_fsync(fd: int) -> None:
        seen.append(f"fsync {Path(os.readlink(f'/proc/self/fd/{fd}')).name}")
        fsync(fd)

    def watched_rename(old: Any, new: Any) -> None:
        seen.append(f"rename {Path(old).name} {Path(new).name}")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "rename", watched_rename)
    with held(b"abc") as blob:
        durable.copy_in(blob.fd, blob.size, tmp_path / "a")
    assert seen == ["fsync .a.part", "rename .a.part a", f"fsync {tmp_path.name}"]


def test_writing_replaces_whole(tmp_path: Path) -> None:
    durable.write_file(tmp_path / "a", b"old")
    durable.write_file(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"


def test_temporary_names_are_told_apart(tmp_path: Path) -> None:
    assert durable.is_temporary(durable.temporary(tmp_path / "000001.dng").name)
    assert not durable.is_temporary("000001.part")
    assert not durable.is_temporary(".lock")


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
