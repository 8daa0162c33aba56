from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dappled import durable
from tests.flight.makers import held


def test_bytes_come_in_with_their_hash(tmp_path: Path) -> None:
    data = os.urandom(9_000_001)  # more than two chunks
    with held(data) as blob:
        assert durable.take_in(blob.fd, blob.size, tmp_path / "a") == hashlib.sha256(data).hexdigest()
    assert (tmp_path / "a").read_bytes() == data
    assert os.listdir(tmp_path) == ["a"]
    assert durable.hash_file(tmp_path / "a") == hashlib.sha256(data).hexdigest()


def test_a_source_that_ends_early_leaves_nothing(tmp_path: Path) -> None:
    with held(b"abc", size=4) as blob, pytest.raises(EOFError, match="only 3 of 4 bytes"):
        durable.take_in(blob.fd, blob.size, tmp_path / "a")
    assert os.listdir(tmp_path) == []


@pytest.mark.timeout(30)
@pytest.mark.parametrize("planted", [os.mkfifo, lambda part: os.link(part.with_name("victim"), part)])
def test_what_stands_under_the_temporary_name_is_neither_waited_for_nor_written_to(
    tmp_path: Path, planted: Callable[[Path], None]
) -> None:
    (tmp_path / "victim").write_bytes(b"somebody's")
    planted(tmp_path / ".a.part")
    durable.write_file(tmp_path / "a", b"ours")
    assert sorted(os.listdir(tmp_path)) == ["a", "victim"]
    assert ((tmp_path / "a").read_bytes(), (tmp_path / "victim").read_bytes()) == (b"ours", b"somebody's")


@pytest.mark.parametrize("call", ["sendfile", "fsync", "replace"])
def test_a_fault_before_the_rename_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    with held(b"abc") as blob:
        monkeypatch.setattr(os, call, refuse)
        with pytest.raises(OSError, match="no space"):
            durable.take_in(blob.fd, blob.size, tmp_path / "a")
        monkeypatch.undo()
    assert os.listdir(tmp_path) == []


def test_the_order_is_file_then_name_then_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    fsync, rename = os.fsync, os.replace

    def watched_fsync(fd: int) -> None:
        seen.append(f"fsync {Path(os.readlink(f'/proc/self/fd/{fd}')).name}")
        fsync(fd)

    def watched_rename(old: Any, new: Any, **folders: Any) -> None:
        seen.append(f"rename {Path(old).name} {Path(new).name}")
        rename(old, new, **folders)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", watched_rename)
    with held(b"abc") as blob:
        durable.take_in(blob.fd, blob.size, tmp_path / "a")
    assert seen == ["fsync .a.part", "rename .a.part a", f"fsync {tmp_path.name}"]


def test_a_file_without_a_name_gets_one_after_its_bytes_are_sure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    fsync, link = os.fsync, os.link

    def watched_fsync(fd: int) -> None:
        seen.append(f"fsync {Path(os.readlink(f'/proc/self/fd/{fd}')).name.partition('#')[0]}")
        fsync(fd)

    def watched_link(old: Any, new: Any, **folders: Any) -> None:
        seen.append(f"link {Path(new).name}")
        link(old, new, **folders)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "link", watched_link)
    fd = durable.unnamed(tmp_path)
    durable.write_all(fd, b"abc")
    assert os.listdir(tmp_path) == []
    assert durable.take_in(fd, 3, tmp_path / "a", "its hash") == "its hash"
    assert seen == ["fsync ", "link a", f"fsync {tmp_path.name}"]
    assert (tmp_path / "a").stat().st_ino == os.fstat(fd).st_ino
    os.close(fd)
    assert (tmp_path / "a").read_bytes() == b"abc"
    assert os.listdir(tmp_path) == ["a"]


def test_a_name_that_is_taken_stays_that_file_s(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"older")
    fd = durable.unnamed(tmp_path)
    durable.write_all(fd, b"abc")
    with pytest.raises(FileExistsError):
        durable.take_in(fd, 3, tmp_path / "a", "its hash")
    os.close(fd)
    assert (tmp_path / "a").read_bytes() == b"older"


def test_a_file_that_has_or_had_a_name_is_copied(tmp_path: Path) -> None:
    """It is somebody's; and one that was removed can't come back."""
    for removed in (False, True):
        theirs = tmp_path / "theirs"
        theirs.write_bytes(b"abc")
        fd = os.open(theirs, os.O_RDONLY)
        if removed:
            theirs.unlink()
        path = tmp_path / f"ours-{removed}"
        assert durable.take_in(fd, 3, path, "its hash") == "its hash"
        assert path.stat().st_ino != os.fstat(fd).st_ino
        assert path.read_bytes() == b"abc"
        os.close(fd)


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EPERM, errno.EXDEV])
def test_a_file_without_a_name_that_can_t_get_one_is_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Without /proc, for one."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    fd = durable.unnamed(tmp_path)
    durable.write_all(fd, b"abc")
    monkeypatch.setattr(os, "link", refuse)
    durable.take_in(fd, 3, tmp_path / "a", "its hash")
    os.close(fd)
    assert (tmp_path / "a").read_bytes() == b"abc"
    assert os.listdir(tmp_path) == ["a"]


def test_each_folder_that_is_made_stands_in_its_parent_for_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(Path(os.readlink(f"/proc/self/fd/{fd}")).name))
    durable.make_folder(tmp_path / "a" / "b")
    assert synced == [tmp_path.name, "a"]


def test_writing_replaces_whole(tmp_path: Path) -> None:
    durable.write_file(tmp_path / "a", b"old")
    durable.write_file(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"


def test_temporary_names_are_told_apart(tmp_path: Path) -> None:
    assert durable.is_temporary(durable.temporary(tmp_path / "000001.dng").name)
    assert not durable.is_temporary("000001.part")
    assert not durable.is_temporary(".lock")
