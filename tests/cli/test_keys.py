"""`dappled keys` and `dappled mavlink key`: files with the right modes, and a sentence for what stands in the way."""

from __future__ import annotations

import hashlib
import io
import json
import stat
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.daemon.stream import curve


def test_a_pair_is_made_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", "make", "vehicle", "-o", str(tmp_path), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    own = curve.load_own(Path(made["secret"]))
    assert main(["keys", "show", made["public"]]) == 0
    assert capsys.readouterr().out.strip() == own.public.decode()
    assert main(["keys", "make", "vehicle", "-o", str(tmp_path)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_token_is_made_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "token"
    assert main(["keys", "token", str(path)]) == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(path.read_text().strip()) == 32
    assert path.read_text().strip() not in capsys.readouterr().out
    assert main(["keys", "token", str(path)]) == 1
    assert main(["keys", "token", str(tmp_path / "no" / "folder")]) == 2
    assert "can't be written" in capsys.readouterr().err


def test_watch_wants_both_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "tcp://127.0.0.1:1", "--keys", str(tmp_path / "a")]) == 2
    assert "go together" in capsys.readouterr().err


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
