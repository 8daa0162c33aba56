"""`dappled mavlink key` as a user types it."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest

from dappled.cli import main


def test_a_random_key_and_one_from_a_passphrase(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mavlink", "key", str(tmp_path / "a.key")]) == 0
    assert "keys = [" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.StringIO("swordfish\n"))
    assert main(["mavlink", "key", str(tmp_path / "b.key"), "--passphrase"]) == 0
    assert (tmp_path / "b.key").read_text().strip() == hashlib.sha256(b"swordfish").hexdigest()
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    assert main(["mavlink", "key", str(tmp_path / "c.key"), "--passphrase"]) == 1
    assert main(["mavlink", "key", str(tmp_path / "a.key")]) == 1
    assert "exists already" in capsys.readouterr().err
