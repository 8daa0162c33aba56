"""What `dappled replay` refuses before it reads a frame."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.flight import recording


@pytest.mark.parametrize(
    "words",
    [
        ["--telemetry", "."],
        ["--match", "*.dng"],
        ["--start", "2026-11-21T10:15:03Z"],
        ["--interval", "1.0"],  # also what would be taken for a folder
        ["--verify", "--interval", "0"],
    ],
)
def test_what_is_for_folders_is_refused_for_a_flight(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = recording.begin(tmp_path / "flights", RecordedClock(1_790_000_000 * 10**9))
    flight.close()
    assert main(["replay", str(flight.folder.path), *words]) == 2
    usage, sentence = capsys.readouterr().err.splitlines()
    assert usage.startswith("usage: dappled replay ")
    assert sentence.startswith(f"dappled replay: {words[-2]} is for a folder of frames: ")
