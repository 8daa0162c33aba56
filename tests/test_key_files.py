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
from dappled.key_files import KeyFileError

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
    for path in tmp_path.iterdir():
        if path.suffix != ".key":  # a public key is for all
            assert key_files.read(path, "a key")


def test_what_others_can_use_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    key_files.make(path, "ab" * 32)
    assert key_files.read_key(path, "a key") == b"\xab" * 32
    path.chmod(0o604)
    with pytest.raises(KeyFileError, match="chmod 600"):
        key_files.read(path, "a key")
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(KeyFileError, match="no file of this user"):  # and it does not block
        key_files.read(tmp_path / "pipe", "a key")
    with pytest.raises(KeyFileError, match="can't be read as a key: Is a directory"):
        key_files.read(tmp_path, "a key")


@pytest.mark.parametrize("text", [b"", b"beef", b"\xff" * 64, b"zz" * 32, b"ab" * 33])
def test_anything_else_is_no_key(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "key").write_bytes(text)
    (tmp_path / "key").chmod(0o600)
    with pytest.raises(KeyFileError):
        key_files.read_key(tmp_path / "key", "a key")
