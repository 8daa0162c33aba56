"""What the pilot is told of problems: each once, and that they are gone."""

from __future__ import annotations

from dappled.daemon.pilot import PIECE_BYTES, Alarms, PilotLines
from dappled.drivers.mavlink import mavlink


def test_a_problem_is_told_once_though_its_numbers_change_and_its_end_too() -> None:
    alarms = Alarms()
    warning, info = mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_INFO
    assert alarms.lines([]) == []
    assert alarms.lines(["409 MB left"]) == [("409 MB left", warning)]
    troubled = [alarms.troubled]
    assert alarms.lines(["408 MB left", "no camera"]) == [("no camera", warning)]
    assert alarms.lines(["407 MB left"]) == []
    assert alarms.lines([]) == [("all is well again", info)]
    assert [*troubled, alarms.troubled] == [True, False]
    assert alarms.lines(["409 MB left"]) == [("409 MB left", warning)]


def test_a_sentence_goes_in_pieces_and_not_twice_in_ten_seconds() -> None:
    lines = PilotLines()
    text = "x" * (PIECE_BYTES + 5)
    assert len(lines.messages(text, 4, 0)) == 2
    assert lines.messages(text, 4, 9 * 10**9) == []
    assert len(lines.messages(text, 4, 10 * 10**9)) == 2
