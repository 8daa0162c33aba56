"""What a command says while it waits."""

from __future__ import annotations

import time

import pytest

from dappled.cli.waiting import waiting_for


def test_silence_is_explained_and_an_answer_in_time_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    with waiting_for("a camera on udpout:127.0.0.1:1", silence_s=0.0):
        until = time.monotonic() + 20
        said = ""
        while not said and time.monotonic() < until:
            said = capsys.readouterr().err
    assert said == "waiting for a camera on udpout:127.0.0.1:1\n"
    with waiting_for("nothing", silence_s=600):
        pass
    assert capsys.readouterr().err == ""
