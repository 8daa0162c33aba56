"""`dappled status` in front of a stream."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.daemon.stream.publisher import Publisher
from tests.daemon.health.test_metrics import HEALTH


@pytest.fixture
def stream(tmp_path: Path) -> Iterator[str]:
    """A publisher that says the same health again and again."""
    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, f"ipc://{tmp_path}/a", answer=lambda _request, _reply: None, high_water_mark=8)
    publisher.start("20261121T101503Z-1a2b3c4d")
    ended = threading.Event()

    def say() -> None:
        while not ended.wait(0.02):
            publisher.publish("health", {"utc_ns": 1, **HEALTH})

    speaker = threading.Thread(target=say)
    speaker.start()
    yield endpoint
    ended.set()
    speaker.join()
    publisher.stop()


def test_one_screen_says_how_it_is(stream: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", stream, "--timeout", "20"]) == 0
    said = capsys.readouterr().out
    assert "camera    faulted: it hangs" in said
    assert "udpin:0.0.0.0:14560: 1200 in, 34 out, 2 bad, 0 unsent; signed: 9 good, 3 forged, 1 replayed" in said
    assert "disk      unknown, /x" in said
    assert "9 wished, 7 safe, 1 failed, 1 pending, 3 refused" in said
    assert "problem   the camera is faulted: it hangs" in said


def test_the_record_itself_as_json(stream: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", stream, "--timeout", "20", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["flight"] == "20261121T101503Z-1a2b3c4d"
    assert told["shots"] == HEALTH["shots"]


def test_nobody_there_is_said_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", f"ipc://{tmp_path}/nobody", "--timeout", "0.2"]) == 1
    assert "no daemon was heard on" in capsys.readouterr().err
