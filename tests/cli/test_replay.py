"""What `dappled replay` refuses before it reads a frame, and how it ends when its reader has gone."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from dappled import codec
from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.daemon.pipeline import decode_process
from dappled.drivers.camera import Blob
from dappled.drivers.child_process import ChannelMessage, ProcessChannel
from dappled.findings import FRAME, Code, finding
from dappled.flight import recording
from dappled.workers import Loop


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


@pytest.mark.parametrize("last", [-3.4, -16.0], ids=["there", "fallen out"])
def test_a_mask_that_fell_out_is_in_doubt_and_frames_that_cant_show_it_are_not(
    last: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first of three frames shows the mask."""
    nats = [120.0, -0.5, last]
    for index in range(len(nats)):
        Image.new("RGB", (16, 16)).save(tmp_path / f"{index}.jpg")
    unseen = finding(Code.MASK_UNSEEN, FRAME, nats=last)

    def answer(question: ChannelMessage) -> tuple[Mapping[str, Any], tuple[int, ...]]:
        if question.body["do"] != "decode":
            return ({} if question.body["do"] == "set up" else {"ready": True}), ()
        one = nats[question.body["index"]]
        facts = {"sha256": "", "arrays": [], "carriers": [], "carriers_from": "calibrated", "carriers_found": 0}
        facts |= {"carriers_predicted": 24, "law": "geometric", "grid": [], "preview_size": [1, 1], "picture": None}
        facts |= {"mask_nats": one, "decision": None, "doubts": codec.plain((unseen,) if one < 0 else ())}
        return facts, (Blob.of(b"x").fd, Blob.of(b"x").fd)

    here, there = ProcessChannel.pair()
    worker = Loop("worker", lambda: decode_process.serve(there, answer))
    worker.start()
    process = SimpleNamespace(poll=lambda: None, returncode=0)
    monkeypatch.setattr(decode_process, "start_child", lambda *_, **__: (process, here))
    monkeypatch.setattr(decode_process, "end_child", lambda *_: None)
    assert main(["replay", str(tmp_path), "--mask", "reference-5x5"]) == (0 if last > -10 else 1)
    assert "the mask is seen in 1 of 3 frames, and can't be seen in 2" in capsys.readouterr().err
    assert worker.stop(60.0)
    there.close()
