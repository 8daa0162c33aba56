"""What the pilot is told of findings: each once, and that they have ended."""

from __future__ import annotations

from typing import Any

from dappled import codec
from dappled.daemon.health.status_text import AGAIN_NS, AWAY_NS, PIECE_BYTES, Alarms, GroundStations, PilotMessages
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import Code, Finding, Level, Subject, finding, told

CAMERA = finding(Code.CAMERA_ABSENT, Subject("camera"), reason="")


def disk(left_mb: int) -> Finding:
    return finding(Code.DISK_FILLING, Subject("disk"), left_mb=left_mb, least_mb=200)


def words(one: Finding) -> str:
    return f"{told(one)} [{one.code}]"


def health(*found: Finding, age_s: float = 60.0) -> dict[str, Any]:
    return {"findings": [{**codec.plain(one), "age_s": age_s} for one in found]}


def test_a_finding_is_told_once_though_its_numbers_change_and_its_end_too() -> None:
    alarms = Alarms()
    warning, info = mavlink.MAV_SEVERITY_WARNING, mavlink.MAV_SEVERITY_INFO
    assert alarms.lines(health()) == []
    assert alarms.lines(health(disk(409))) == [(words(disk(409)), warning)]
    troubled = [alarms.troubled]
    assert alarms.lines(health(CAMERA, disk(408))) == [(words(CAMERA), mavlink.MAV_SEVERITY_ERROR)]
    troubled += [alarms.troubled]
    assert alarms.lines(health(disk(407))) == [("over: the camera is absent", info)]
    assert alarms.lines(health(disk(406))) == []
    assert alarms.lines(health()) == [("all is well again", info)]
    assert [*troubled, alarms.troubled] == [False, True, False]
    assert alarms.lines(health(disk(409))) == [(words(disk(409)), warning)]


def test_a_sentence_goes_in_pieces_and_not_twice_in_ten_seconds() -> None:
    lines = PilotMessages()
    text = "x" * (PIECE_BYTES + 5)
    assert len(lines.messages(text, 4, 0)) == 2
    assert lines.messages(text, 4, 9 * 10**9) == []
    assert len(lines.messages(text, 4, 10 * 10**9)) == 2


def test_a_sentence_too_long_for_its_pieces_keeps_its_code() -> None:
    long = finding(Code.CAMERA_ABSENT, Subject("camera"), reason="no bus, " * 50)
    ((said, severity),) = Alarms().lines(health(long))
    assert said.endswith("... [camera.absent]")
    pieces = PilotMessages().messages(said, severity, 0)
    assert b"".join(one.text.encode().rstrip(b"\0") for one in pieces).decode() == said


def test_what_comes_back_at_once_is_told_again() -> None:
    lines = PilotMessages()
    assert all(lines.messages("the camera is absent", 3, now_ns, news=True) for now_ns in (0, 3 * 10**9))


def test_all_is_well_when_nothing_stands_that_may_still_settle() -> None:
    alarms = Alarms()
    starting = finding(Code.CAMERA_STARTING, Subject("camera"))
    alarms.lines(health(CAMERA))
    assert alarms.lines(health(starting, age_s=0.0)) == [("over: the camera is absent", mavlink.MAV_SEVERITY_INFO)]
    assert alarms.lines(health(starting, age_s=1.0)) == []
    assert alarms.lines(health()) == [("all is well again", mavlink.MAV_SEVERITY_INFO)]


def test_what_becomes_a_stop_is_told_again_and_is_not_over_as_a_caution() -> None:
    alarms = Alarms()
    silent = finding(Code.LINK_SILENT, Subject("link", "a"), Level.CAUTION, seconds=5)
    worse = finding(Code.LINK_SILENT, Subject("link", "a"), Level.STOP, seconds=9)
    assert [severity for _, severity in alarms.lines(health(silent))] == [mavlink.MAV_SEVERITY_WARNING]
    assert [severity for _, severity in alarms.lines(health(worse))] == [mavlink.MAV_SEVERITY_ERROR]
    assert alarms.lines(health(silent)) == []


def test_what_lasts_is_told_again_when_it_is_asked_for() -> None:
    alarms = Alarms()
    alarms.lines(health(CAMERA))
    assert alarms.lines(health(CAMERA), again=True) == [(words(CAMERA), mavlink.MAV_SEVERITY_ERROR)]
    assert alarms.lines(health(), again=True) == [("all is well again", mavlink.MAV_SEVERITY_INFO)]
    assert alarms.lines(health(), again=True) == []


def heartbeat(system: int, kind: int = mavlink.MAV_TYPE_GCS) -> MavlinkMessage:
    message = mavlink.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3)
    packer = mavlink.MAVLink(None, system, 190)
    message.pack(packer)
    return packer.decode(bytearray(message.get_msgbuf()))


def test_a_ground_station_that_comes_late_or_back_is_news_once() -> None:
    stations, now_ns = GroundStations(), 0
    stations.heard(heartbeat(1, mavlink.MAV_TYPE_QUADROTOR), now_ns)
    assert not stations.new_one(AGAIN_NS)
    stations.heard(heartbeat(255), now_ns)
    assert [stations.new_one(AGAIN_NS - 1), stations.new_one(AGAIN_NS), stations.new_one(AGAIN_NS)] == [
        False,
        True,
        False,
    ]
    stations.heard(heartbeat(255), AWAY_NS)
    assert not stations.new_one(AWAY_NS + AGAIN_NS)  # it was there all the time
    stations.heard(heartbeat(255), 3 * AWAY_NS)
    assert stations.new_one(3 * AWAY_NS + AGAIN_NS)
    for system in range(1, 200):  # bounded, whoever invents stations
        stations.heard(heartbeat(system), 4 * AWAY_NS)
    assert stations.new_one(4 * AWAY_NS + AGAIN_NS)
