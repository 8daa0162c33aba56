"""What `dappled replay` refuses before it reads a frame, and how it ends when its reader has gone."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import pytest
from PIL import Image

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


@pytest.mark.parametrize(
    "words",
    [
        ["--start", "9999-12-31T23:59:59Z"],  # beyond what 64 bits of nanoseconds hold
        ["--start", "0001-01-01T00:00:00+14:00"],
        ["--interval", "1e300"],
        ["--match", "/etc/*"],
    ],
)
def test_times_and_names_that_lead_nowhere_are_one_sentence(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (16, 16)).save(tmp_path / "1.jpg")
    with contextlib.suppress(SystemExit):  # of argparse
        assert main(["replay", str(tmp_path), *words])
    (sentence,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("usage: ")]
    assert words[0] in sentence
    assert "unexpected" not in sentence


@pytest.mark.parametrize("pace", ["max", "1000"])
def test_it_ends_when_its_reader_has_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pace: str
) -> None:
    """The lines are printed in a thread of the pipeline. Standard error would say that a shot did not end."""
    for name in ("1.jpg", "2.jpg"):
        Image.new("RGB", (16, 16)).save(tmp_path / name)
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w", encoding="utf-8") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        assert main(["replay", str(tmp_path), "--rate", pace]) == 1
        monkeypatch.undo()
    assert capsys.readouterr().err == ""
