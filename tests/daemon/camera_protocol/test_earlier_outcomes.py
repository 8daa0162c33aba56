"""Outcomes that a daemon owed when it ended, as the next ones report them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes, numbers
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.flight import Recording, recording
from tests.daemon.camera_protocol.test_component import Rig
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, mavlink_2, request
from tests.flight.test_recording import crash

BEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
LOST_1 = ["3 photographs were lost when the daemon ended: ima", "ges 1, 3 to 4"]


def flown(flights: Path) -> Recording:
    """A flight of five shots: 0 and 2 are safe, and only 0 was reported."""
    flight = recording.begin(flights, RecordedClock(START_UTC_NS))
    flight.telemetry.append(1, mavlink_2(b"a"))  # there is a link
    for index in range(5):
        request(flight, index)
        if index in (0, 2):
            deliver(flight, index, b"raw %d" % index)
            flight.note_image(index)
    flight.index.note_reported(0)
    return flight


def restarted(flights: Path, at_s: int) -> tuple[Recording, Rig]:
    after = recording.begin(flights, RecordedClock(START_UTC_NS + at_s * 10**9))
    return after, Rig(earlier=EarlierOutcomes(after.index))


def reported(messages: list[MavlinkMessage]) -> list[tuple[int, int, str]]:
    return [(m.image_index, m.capture_result, m.file_url) for m in messages if m.get_type() == "CAMERA_IMAGE_CAPTURED"]


def texts(messages: list[MavlinkMessage]) -> list[str]:
    return [m.text for m in messages if m.get_type() == "STATUSTEXT"]


def hear_out(rig: Rig, seconds: float) -> list[MavlinkMessage]:
    """All that is sent in these seconds to a ground station that is there."""
    said: list[MavlinkMessage] = []
    for _ in range(round(seconds / 0.02)):
        rig.hear(BEAT)
        rig.tick(0.02)
        said += rig.sent
    return said


def test_a_killed_daemons_shots_are_reported_once_to_the_first_ground_station(tmp_path: Path) -> None:
    crash(flown(tmp_path))
    after, rig = restarted(tmp_path, 60)
    rig.tick(4)
    for _ in range(200):  # nobody there to hear it
        rig.tick(0.02)
        assert not reported(rig.sent)
        assert not texts(rig.sent)
    said = hear_out(rig, 2)
    assert reported(said) == [(1, 0, ""), (2, 1, "frames/000002.cr2"), (3, 0, ""), (4, 0, "")]
    assert texts(said) == LOST_1
    assert not reported(hear_out(rig, 1))
    after.close()
    last, rig = restarted(tmp_path, 120)
    rig.tick(4)
    said = hear_out(rig, 2)
    assert not reported(said)
    assert not texts(said)
    last.close()


def test_reports_are_paced(tmp_path: Path) -> None:
    crash(flown(tmp_path))
    after, rig = restarted(tmp_path, 60)
    rig.tick(4)
    assert len(reported(hear_out(rig, 0.1))) == 1
    assert len(reported(hear_out(rig, 0.1))) == 1
    after.close()


def test_a_second_crash_among_the_reports_repeats_and_forgets_none(tmp_path: Path) -> None:
    crash(flown(tmp_path))
    second, rig = restarted(tmp_path, 60)
    rig.tick(4)
    first = hear_out(rig, 0.2)
    second.telemetry.append(1, mavlink_2(b"a"))
    request(second, 5)
    crash(second)
    third, rig = restarted(tmp_path, 120)
    rig.tick(4)
    then = hear_out(rig, 2)
    assert [index for index, _, _ in reported(first)] == [1, 2]
    assert [index for index, _, _ in reported(then)] == [3, 4, 5]
    assert texts(first) == LOST_1
    assert texts(then) == ["1 photograph was lost when the daemon ended: image", " 5"]  # 3 and 4 were counted before
    third.close()


def test_a_report_that_no_link_takes_is_made_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crash(flown(tmp_path))
    after, rig = restarted(tmp_path, 60)
    rig.tick(4)
    with monkeypatch.context() as down:
        down.setattr(rig, "send", lambda message, link=None, without=(): False)
        hear_out(rig, 1)
    assert [index for index, _, _ in reported(hear_out(rig, 2))] == [1, 2, 3, 4]
    after.close()


def test_a_flight_that_was_moved_away_is_reported_by_the_index(tmp_path: Path) -> None:
    flight = flown(tmp_path)
    crash(flight)
    after, rig = restarted(tmp_path, 60)
    flight.folder.path.rename(tmp_path / "elsewhere")
    rig.tick(4)
    assert [(index, ok) for index, ok, _ in reported(hear_out(rig, 2))] == [(1, 0), (2, 1), (3, 0), (4, 0)]
    after.close()


def test_a_flight_without_a_link_leaves_nothing_to_report(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, RecordedClock(START_UTC_NS))
    request(flight, 0)
    crash(flight)
    after, _ = restarted(tmp_path, 60)
    assert after.index.unreported() == {}
    after.close()


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(b"rotten" * 1000)])
def test_an_index_that_was_lost_reports_the_flight_that_was_cut_short_and_no_older_one(
    tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    closed = recording.begin(tmp_path, RecordedClock(START_UTC_NS))
    closed.telemetry.append(1, mavlink_2(b"a"))
    request(closed, 0)
    closed.close()
    flight = recording.begin(tmp_path, RecordedClock(START_UTC_NS + 10**9))
    flight.telemetry.append(1, mavlink_2(b"a"))
    for index in (1, 2, 3, 4):
        request(flight, index)
    flight.index.note_reported(1)
    crash(flight)
    damage(tmp_path / "index.sqlite")
    after, _ = restarted(tmp_path, 60)
    assert sorted(after.index.unreported()) == [1, 2, 3, 4]  # 1 once more: who knows?
    entry = after.index.lookup(4)
    assert entry is not None  # it can still be asked for
    assert entry.state == "failed"
    after.close()


def test_indices_in_words() -> None:
    assert numbers([7]) == "image 7"
    assert numbers([4, 5, 6, 9]) == "images 4 to 6, 9"
    assert numbers(range(0, 40, 2)) == "images 0, 2, 4, 6, 8, 10, 12, 14 and more"
