"""`dappled watch` in front of a stream."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.daemon.stream.publisher import Publisher
from tests.daemon.stream.test_watch import slices


@pytest.fixture
def stream(tmp_path: Path) -> Iterator[str]:
    """A publisher that sends frame after frame."""
    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, f"ipc://{tmp_path}/a", high_water_mark=8)
    publisher.start("20261121T101503Z-1a2b3c4d", lambda _request, _reply: None)
    ended = threading.Event()

    def send() -> None:
        for frame in itertools.count(1):
            made = slices(frame)
            header = {name: value for name, value in made.header.items() if name != "flight"}
            publisher.publish("slices", header, made.body)
            publisher.publish("health", {"utc_ns": 1})
            if ended.wait(0.02):
                return

    sender = threading.Thread(target=send)
    sender.start()
    yield endpoint
    ended.set()
    sender.join()
    publisher.stop()


def test_what_comes_is_told_and_kept(stream: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = tmp_path / "kept"
    main(["watch", stream, "--ask", f"ipc://{tmp_path}/nobody", "--count", "2", "--timeout", "30", "--save", str(kept)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("slices    seq ")
    assert "2 × 3 × 4  0.0 MB" in lines[0]
    assert not any("health" in line for line in lines)
    assert lines[-1].startswith("2 frames received, ")
    assert len(list(kept.glob("*.npy"))) == 2


def test_as_json(stream: str, capsys: pytest.CaptureFixture[str]) -> None:
    main(["watch", stream, "--count", "1", "--timeout", "30", "--json"])
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert told[-1]["topic"] == "slices"
    assert told[-1]["body_bytes"] == 2 * 3 * 4 * 8


def test_silence_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", f"ipc://{tmp_path}/nobody", "--timeout", "0.1"]) == 1
    said = capsys.readouterr()
    assert "0 frames received" in said.out
    assert f"nothing came from ipc://{tmp_path}/nobody: is a daemon running there?" in said.err


def test_a_daemon_that_sends_no_slices_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, f"ipc://{tmp_path}/a", high_water_mark=8)
    publisher.start("20261121T101503Z-1a2b3c4d", lambda _request, _reply: None)
    over = threading.Event()
    monkeypatch.setattr("dappled.cli.watch._show", lambda *_: over.set())  # one is heard, then silence

    def send() -> None:
        while not over.wait(0.025):
            publisher.publish("health", {"utc_ns": 1})

    sender = threading.Thread(target=send)
    sender.start()
    try:
        assert main(["watch", endpoint, "--timeout", "2"]) == 1
    finally:
        over.set()
        sender.join()
        publisher.stop()
    assert f"too few slices came from {endpoint}: `dappled status {endpoint}`" in capsys.readouterr().err
