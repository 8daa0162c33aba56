"""Questions about recorded frames, each answered once: with the frame, or with a sentence."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from dappled.clock import SystemClock
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.daemon.stream import answers
from dappled.daemon.stream.answers import Answers
from dappled.daemon.stream.wire import Message, WireError
from tests.daemon.fakes import FakeDecoder, Rig, rig
from tests.schemas import schema
from tests.waiting import eventually


@pytest.fixture
def flown(tmp_path: Path) -> Iterator[Rig]:
    """A flight with one frame, still open."""
    with rig(tmp_path) as one:
        one.request(1)
        one.ended(0)
        yield one


def asked(flown: Rig, decoder: FakeDecoder | None, request: dict[str, Any]) -> Message:
    replies: list[Message] = []
    one = Answers(LedgerWriter(flown.flight, SystemClock()), decoder)
    one.start()
    one.answer(request, replies.append)
    one.stop()
    eventually(lambda: replies, "a reply")
    (reply,) = replies
    return reply


def test_a_frame_and_its_slices_are_had_again(flown: Rig) -> None:
    frame = asked(flown, None, {"get": "frame", "frame": 0})
    assert (frame.topic, frame.header["frame"]) == ("frame", 0)
    slices = asked(flown, FakeDecoder(), {"get": "slices", "frame": 0})
    assert (slices.topic, slices.header["slices_sha256"]) == ("slices", "0" * 64)
    assert len(slices.body) == 16
    envelope = {"schema": "dappled/frame", "version": 1, "flight": "f", "seq": None, "dropped": 0}
    jsonschema.validate({**envelope, **frame.header}, schema("frame"))


@pytest.mark.parametrize(
    ("request_", "decode", "words"),
    [
        ({"get": "frame", "frame": 5}, True, "no frame 5"),
        ({"get": "slices", "frame": None}, True, "not started"),
        ({"get": "slices", "frame": 0}, False, "no mask is configured"),
    ],
)
def test_what_can_t_be_answered_is_told(flown: Rig, request_: dict[str, Any], decode: bool, words: str) -> None:
    reply = asked(flown, FakeDecoder() if decode else None, request_)
    assert reply.topic == "error"
    assert words in reply.header["error"]


def test_a_decoder_s_sentence_is_passed_on(flown: Rig) -> None:
    decoder = FakeDecoder()
    decoder.problem = "no carriers"
    assert asked(flown, decoder, {"get": "slices", "frame": 0}).header["error"] == "no carriers"


def test_too_many_questions_are_refused(flown: Rig) -> None:
    one = Answers(LedgerWriter(flown.flight, SystemClock()), None)  # not started: all of it waits
    replies: list[Message] = []
    for _ in range(answers.WAITING):
        one.answer({"get": "frame", "frame": 0}, replies.append)
    with pytest.raises(WireError, match="ask again later"):
        one.answer({"get": "frame", "frame": 0}, replies.append)
    one.start()
    one.stop()
    eventually(lambda: len(replies) == answers.WAITING, "all were answered")
