"""Which daemon's stream a command listens to when nobody names one."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dappled.cli.common import answers, stream
from dappled.errors import DappledError


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's own runtime folder, empty."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "dappled").mkdir()
    return tmp_path / "dappled"


@contextmanager
def listening(path: Path) -> Iterator[None]:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))
        one.listen()
        yield


def test_without_a_service_it_is_the_user_s_own(own: Path, tmp_path: Path) -> None:
    assert stream(None, tmp_path / "no service") == f"ipc://{own}/slices"


def test_a_service_is_found_where_no_daemon_of_the_user_s_own_answers(own: Path, tmp_path: Path) -> None:
    service = tmp_path / "service"
    service.mkdir()
    with listening(own / "slices"):
        assert answers(f"ipc://{own}/slices")
        assert stream(None, service) == f"ipc://{own}/slices"
    assert not answers(f"ipc://{own}/slices")  # what a killed daemon leaves behind
    assert stream(None, service) == f"ipc://{service}/slices"


def test_settings_that_name_an_endpoint_are_obeyed(own: Path, tmp_path: Path) -> None:
    (tmp_path / "dappled.toml").write_text('[publish]\nslices = "tcp://127.0.0.1:5555"\n', encoding="utf-8")
    assert stream(tmp_path / "dappled.toml", tmp_path) == "tcp://127.0.0.1:5555"
    assert not answers("tcp://127.0.0.1:5555")


def test_who_may_not_ask_the_service_is_told_how_to(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may look everywhere
    with pytest.raises(DappledError, match="usermod -aG dappled"):
        stream(None, tmp_path)
