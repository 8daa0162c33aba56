"""Key files: made once and durably, for their owner alone; a failure leaves nothing behind."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dappled import key_files
from dappled.daemon.stream import curve
from dappled.drivers.mavlink import make_key
from dappled.errors import DappledError
from dappled.flight import seal_key

MAKERS: dict[str, Callable[[Path], object]] = {
    "mavlink": lambda folder: make_key(folder / "a"),
    "seal": lambda folder: seal_key.make(folder / "a"),
    "curve": lambda folder: curve.make(folder, "a"),
}


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("good", [0, 1, 2])
def test_half_a_key_does_not_stop_the_next_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, maker: str, good: int
) -> None:
    done, real = [0], os.fsync

    def fsync(fd: int) -> None:
        done[0] += 1
        if done[0] == good + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(fd)

    with monkeypatch.context() as full:
        full.setattr(os, "fsync", fsync)
        if good < 2 or maker == "curve":  # a pair is four calls
            with pytest.raises(DappledError, match=r"No space left|disk is full"):
                MAKERS[maker](tmp_path)
            assert list(tmp_path.iterdir()) == []
            MAKERS[maker](tmp_path)
    assert all(key_files.read(path).own for path in tmp_path.iterdir())


def test_what_others_can_use_is_said(tmp_path: Path) -> None:
    path = tmp_path / "key"
    key_files.write_new(path, "ab" * 32)
    found = key_files.read(path)
    assert (found.own, found.private, key_files.key_in(found.data)) == (True, True, b"\xab" * 32)
    assert "ab" not in repr(found).replace("private", "")
    path.chmod(0o604)
    assert not key_files.read(path).private
    os.mkfifo(tmp_path / "pipe")
    assert not key_files.read(tmp_path / "pipe").own  # and it does not block


@pytest.mark.parametrize("text", [b"", b"beef", b"\xff" * 64, b"zz" * 32, b"ab" * 33])
def test_anything_else_is_no_key(text: bytes) -> None:
    assert key_files.key_in(text) is None
