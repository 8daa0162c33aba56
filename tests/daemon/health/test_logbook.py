"""The log's last lines in words."""

from __future__ import annotations

import logging
from dataclasses import replace

from dappled.clock import RecordedClock
from dappled.daemon.health.logbook import Logbook, of_shot
from dappled.daemon.pipeline.capture import PendingShot
from dappled.flight import Cause, Frame, Shot
from tests.standing import failure

SHOT = Shot(7, Cause("console", "console", 1), 0, 0)
FRAME = Frame(7, "frames/000007.dng", "IMG.DNG", 5_100_000, "0" * 64, 0)


def test_lines_are_numbered_and_bounded() -> None:
    logbook = Logbook(RecordedClock(3), capacity=4)
    for number in range(10):
        logbook.add(f"line {number}")
    assert [line["number"] for line in logbook.after(0)] == [7, 8, 9, 10]
    assert [line["text"] for line in logbook.after(8)] == ["line 8", "line 9"]
    assert len(logbook.after(0, limit=2)) == 2


def test_a_line_said_twice_stands_once() -> None:
    logbook = Logbook(RecordedClock(0))
    logbook.add("the camera is absent")
    logbook.add("the camera is absent")
    assert len(logbook.after(0)) == 1


def test_warnings_of_the_loggers_are_kept_and_lesser_ones_not() -> None:
    logbook = Logbook(RecordedClock(0))
    logger = logging.Logger("dappled.test")
    logger.addHandler(logbook)
    logger.warning("link %s is gone", "a")
    logger.info("nothing of note")
    logger.warning("%d", "not a number")
    texts = [line["text"] for line in logbook.after(0)]
    assert texts[0] == "link a is gone"
    assert len(texts) == 2
    assert "TypeError" in texts[1]


def test_a_shot_in_words() -> None:
    pending = PendingShot(SHOT, frame=FRAME)
    assert of_shot(pending) == ("frame 7 is safe, 5.1 MB", "info")
    assert of_shot(replace(pending, problem=failure("not decoded: no carriers"))) == (
        "frame 7: not decoded: no carriers",
        "warning",
    )
    assert of_shot(PendingShot(SHOT, problem=failure("the mirror is stuck"))) == (
        "shot 7: the mirror is stuck",
        "warning",
    )
