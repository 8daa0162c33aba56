"""What the person who started a daemon reads."""

from __future__ import annotations

import logging
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from dappled import codec
from dappled.cli.terminal import CameraRemarks, FrameLines, ProblemRemarks, frame_line, waiting_for
from dappled.clock import RecordedClock
from dappled.daemon.health import systemd
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.service import Service
from dappled.drivers.camera import BodyState, StateChanged
from dappled.findings import Code, Finding, Subject, finding
from tests.daemon.health.test_metrics import HEALTH
from tests.daemon.health.test_systemd import read
from tests.flight.makers import shot
from tests.standing import failure


def test_a_line_for_each_frame(capsys: pytest.CaptureFixture[str]) -> None:
    frames = FrameLines()
    for index in range(20):
        frames.finished(PendingShot(shot(index)))
    frames.close()
    assert capsys.readouterr().out.splitlines() == [frame_line(PendingShot(shot(index))) for index in range(20)]


def test_a_terminal_that_is_gone_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone:
        def write(self, _text: str) -> int:
            raise BrokenPipeError

        def flush(self) -> None:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Gone())
    frames = FrameLines()
    frames.finished(PendingShot(shot(0)))
    frames.close()
    with sys.stdout as nowhere:
        assert nowhere.name == "/dev/null"


def test_the_camera_is_told_of_when_it_changes() -> None:
    said: list[str] = []
    camera = CameraRemarks(lambda text, *_, **__: said.append(text))
    states: list[tuple[BodyState, str]] = [
        ("ready", ""),
        ("busy", ""),
        ("ready", ""),
        ("faulted", "it hangs"),
        ("ready", ""),
    ]
    for state, reason in states:
        camera.changed(StateChanged(state, reason, 0))
    assert said == ["camera ready", "camera faulted: it hangs", "camera ready"]
    assert camera.state == "ready"


def test_a_finding_is_said_once_each_time_it_begins() -> None:
    said: list[str] = []
    lines: list[str] = []
    here: list[Finding] = []
    clock = RecordedClock(10**10)

    class Daemon:
        def health(self) -> Mapping[str, Any]:
            return {**HEALTH, "findings": [{**codec.plain(one), "age_s": 0.0} for one in here]}

    remarks = ProblemRemarks(
        cast(Service, Daemon()),
        lines.append,
        say=lambda text, *_, **__: said.append(text),
        clock=clock,
    )
    remarks.look()
    assert lines == []  # not yet a second old
    a, b = (finding(Code.THREAD_ENDED, Subject("thread", name)) for name in "ab")
    words = {one: f"thread {name}: it has ended: restart dappled" for one, name in ((a, "a"), (b, "b"))}
    for now in ([b, a], [a], [a, b]):
        here[:] = now
        clock.advance(1)
        remarks.look()
        remarks.look()
    assert said == [f"stop: {words[one]}" for one in (b, a, b)]
    assert [line.split("; ", 1)[1] for line in lines] == [
        f"{words[b]}; {words[a]}",
        words[a],
        f"{words[a]}; {words[b]}",
    ]
    here[:] = [a.with_facts(thread="other"), finding(Code.SERVICE_STOPPING, Subject("service"))]
    clock.advance(1)
    remarks.look()
    assert len(said) == 3  # facts that change are no news, and notes are none
    here[:] = [finding(Code.DISK_FULL, Subject("disk"), left_kb=1)]
    remarks.look(now=True)
    assert said[-1].startswith("stop: the disk is full")


def test_in_the_journal_a_frame_can_be_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "j"))
        listener.settimeout(60)
        root = logging.getLogger()
        handler, before = systemd.JournalHandler(str(tmp_path / "j")), root.level
        root.addHandler(handler)
        root.setLevel(logging.INFO)
        try:
            frames = FrameLines()
            frames.finished(PendingShot(shot(42), problem=failure("it hangs")))
            CameraRemarks().changed(StateChanged("ready", "", 0))
            frames.close()
            told = {entry["MESSAGE"]: entry for entry in (read(listener.recv(10_000)), read(listener.recv(10_000)))}
        finally:
            root.removeHandler(handler)
            root.setLevel(before)
            handler.close()
    assert capsys.readouterr() == ("", "")
    frame = told[frame_line(PendingShot(shot(42), problem=failure("it hangs")))]
    asked = {name: frame[f"DAPPLED_{name}"] for name in ("FRAME", "STATE", "PROBLEM")}
    assert asked == {"FRAME": "42", "STATE": "failed", "PROBLEM": "it hangs"}
    assert frame["PRIORITY"] == "4"
    assert told["camera ready"]["DAPPLED_CAMERA"] == "ready"


def test_silence_is_explained_and_an_answer_in_time_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    with waiting_for("a camera on udpout:127.0.0.1:1", silence_s=0.0):
        until = time.monotonic() + 60
        said = ""
        while not said and time.monotonic() < until:
            said = capsys.readouterr().err
    assert said == "waiting for a camera on udpout:127.0.0.1:1\n"
    with waiting_for("nothing", silence_s=600):
        pass
    assert capsys.readouterr().err == ""
