"""The autopilot's own log, the requests and the files of one flight: each trigger that is not in all three is named."""

from __future__ import annotations

import contextlib
import json
import math
import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.daemon.replay import three_books
from dappled.drivers.mavlink import dataflash, mavlink, pack, ulog
from dappled.drivers.mavlink.log_packets import AutopilotLogError
from dappled.errors import DappledError
from dappled.findings import Code, Subject, finding, text
from dappled.flight import Cause, Shot, recording
from dappled.mocks.autopilot.path import FlightPath
from tests.drivers.mavlink import logs_here
from tests.drivers.mavlink.true_logs import (
    BOOT_US,
    SPAN_S,
    UTC_US,
    Row,
    add_px4_triggers,
    add_triggers,
    rewritten,
    ulog_written,
    written,
)
from tests.flight.makers import deliver
from tests.standing import failure

TIMES_S = {number: 0.5 + 0.5 * number for number in range(1, 10)}  # 1.0 s to 5.0 s
LINK_US = 20_000
AGAIN_US = BOOT_US + 2_700_000  # since when an autopilot is on that has started again, in the first one's time
OWN, STATION = "mavlink:1/1", "mavlink:255/190"
_Shot = tuple[float, str, str, int | None]  # time on the path, source, kind, number


def requested(
    times_s: Mapping[int, float] = TIMES_S, kind: str = "IMAGE_START_CAPTURE", *, numbers: bool = True
) -> list[_Shot]:
    return [(t_s, OWN, kind, number if numbers else None) for number, t_s in times_s.items()]


@pytest.fixture(autouse=True)
def logs_read_here(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a process for each, but for damaged ones."""
    if "damaged" not in request.node.name:
        monkeypatch.setattr("dappled.drivers.reader_process.read", logs_here.read)


@pytest.fixture
def fly(tmp_path: Path) -> Callable[..., Path]:
    """Record a flight of these shots; those in `failed` (places in the list) have no file. `heard` are requests in the
    telemetry; `late_s` is when the autopilot was started, after that of the logs; `ahead_s` its UTC in the telemetry
    against that of the logs. SYSTEM_TIME comes later by `time_delays_s`, in turn. `fed_back`: (time, number, camera) of
    each CAMERA_FEEDBACK."""

    def record(
        shots: list[_Shot],
        *,
        failed: tuple[int, ...] = (),
        heard: Sequence[_Shot] = (),
        late_s: float = 0.0,
        ends_s: float = SPAN_S + 2,
        time_delays_s: Sequence[float] = (0.0,),
        ahead_s: float = 0.0,
        fired_by: str = "",
        again_s: float = math.inf,
        ports: int = 1,
        fed_back: Sequence[tuple[float, int, int]] = (),
    ) -> Path:
        settings = {"camera": {"driver": "folder", "shutter": fired_by}} if fired_by else {}
        flight = recording.begin(tmp_path / "flights", RecordedClock(UTC_US * 1000), {"settings": settings})
        flight.ledger.set_fact("vehicles", [[0, 1]])
        packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for step in range(-2, round(2 * ends_s)):
            t_us = 250_000 + 500_000 * step
            boot_us = BOOT_US + t_us - (AGAIN_US if t_us >= again_s * 1e6 else 0)
            utc_us = UTC_US + t_us + round((late_s + ahead_s) * 1e6)
            delay_us = round(time_delays_s[step % len(time_delays_s)] * 1e6)
            message = mavlink.MAVLink_system_time_message(utc_us, boot_us // 1000)
            for port in range(ports):
                stamp_us = UTC_US + t_us + (1 + port) * LINK_US + delay_us
                flight.telemetry.append(stamp_us, pack(message, packer, version_1=False))
        for t_s, _, _, number in heard:
            command = mavlink.MAVLink_command_long_message(
                1, 100, mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 0, 1, number or 0, 0, 0, 0
            )
            for port in range(ports):
                stamp_us = UTC_US + round(t_s * 1e6) + (1 + port) * LINK_US
                flight.telemetry.append(stamp_us, pack(command, packer, version_1=False))
        for t_s, number, camera in fed_back:
            report = mavlink.MAVLink_camera_feedback_message(0, 1, camera, number, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
            flight.telemetry.append(UTC_US + round(t_s * 1e6) + LINK_US, pack(report, packer, version_1=False))
        for index, (t_s, source, kind, number) in enumerate(shots):
            at_ns = (UTC_US + round(t_s * 1e6) + LINK_US) * 1000
            shot = Shot(index, Cause(source, kind, number), at_ns, at_ns)
            flight.journal.note(shot)
            flight.ledger.add_shot(shot)
            flight.ledger.fired(index, at_ns, at_ns)
            if index in failed:
                flight.ledger.failed(index, failure("no file came"))
            else:
                deliver(flight, index, b"%d" % index, f"IMG_{index}.RAF")
        flight.close()
        return flight.folder.path

    return record


@pytest.fixture
def bin_log(tmp_path: Path) -> Path:
    return written(tmp_path)[0]


def report(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[str]]:
    code = main(["flight", "report", *map(str, arguments)])
    return code, capsys.readouterr().out.splitlines()


def test_books_that_balance(fly: Callable[..., Path], bin_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add_triggers(bin_log, TIMES_S)
    add_triggers(bin_log, {1: 0.2, 2: 0.3}, camera=1)  # of another camera
    code, said = report(capsys, fly(requested()), "--log", bin_log)
    assert code == 0
    assert said[-2].split() == ["9", "triggers", "in", "ArduPilot's", "00000012.bin:", "9", "shots,", "9", "files"]
    assert said[-1] == "the three books balance: the autopilot's triggers, the requests and the files"


def test_each_trigger_that_is_not_in_all_three_is_named(
    fly: Callable[..., Path], bin_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """3 was lost on the link, 4 was refused, 5 has no file, 6 made two shots; 7 is not in the log, and 8 twice."""
    add_triggers(bin_log, {number: t_s for number, t_s in TIMES_S.items() if number != 7})
    add_triggers(bin_log, {8: TIMES_S[8] + 0.001})
    shots = [one for one in requested() if one[3] not in (3, 4)]
    shots.append((TIMES_S[6] + 0.1, STATION, "DO_DIGICAM_CONTROL", None))
    flight = fly(shots, failed=(2,), heard=[one for one in requested() if one[3] == 4])
    code, said = report(capsys, flight, "--log", bin_log, "--json")
    assert code == 1
    log = json.loads("\n".join(said))["log"]
    found = {(one["kind"], one["number"], tuple(one["shots"]), one["reason"]["code"]) for one in log["imbalances"]}
    assert found == {
        ("lost", 3, (), "trigger.unheard"),
        ("refused", 4, (), "trigger.no_shot"),
        ("without a file", 5, (2,), "shot.failed"),
        ("doubled", 6, (3, 7), "trigger.two_shots"),
        ("phantom", None, (4,), "shot.no_trigger"),
        ("doubled", 8, (), "trigger.twice"),
    }
    assert (log["triggers"], log["shots"], log["files"], log["balanced"]) == (8, 6, 5, False)
    true = FlightPath(5).pose(TIMES_S[3])
    lost = next(one for one in log["imbalances"] if one["kind"] == "lost")
    assert abs(lost["utc_ns"] / 1e9 - UTC_US / 1e6 - TIMES_S[3]) < 0.005
    assert lost["place"] == pytest.approx((true.latitude_deg, true.longitude_deg), abs=1e-6)
    _, said = report(capsys, flight, "--log", bin_log)
    place = f"{true.latitude_deg:.6f}, {true.longitude_deg:.6f}"
    assert f"lost: trigger 3 at 2026-11-21T10:15:05.0Z near {place}: no request reached the camera" in said
    phantom = next(line for line in said if line.startswith("phantom"))
    assert "shot 4 at 2026-11-21T10:15:07.0Z" in phantom
    assert "number 7); the log has no such trigger" in phantom
    assert said[-1].startswith("THE THREE BOOKS DO NOT BALANCE: 1 lost, 1 refused, 1 without a file")


def test_what_two_ports_of_the_autopilot_have_brought_is_counted_once(
    fly: Callable[..., Path], bin_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_triggers(bin_log, TIMES_S)
    code, said = report(capsys, fly(requested(), heard=requested(), ports=2), "--log", bin_log)
    assert (code, said[-2].split()[0]) == (0, "9")
    assert not any(line.startswith("doubled") for line in said)


@pytest.mark.parametrize("removed", [3, None])
def test_shots_without_numbers_belong_to_the_triggers_next_to_them(
    fly: Callable[..., Path], bin_log: Path, removed: int | None
) -> None:
    """CAM1_TYPE 5 broadcasts commands that have no number."""
    add_triggers(bin_log, TIMES_S)
    kept = {number: t_s for number, t_s in TIMES_S.items() if number != removed}
    flight = fly(requested(kept, "DO_DIGICAM_CONTROL", numbers=False))
    found = three_books.reconcile(flight, [bin_log])
    assert [(one.kind, one.number) for one in found.imbalances] == ([("lost", removed)] if removed else [])
    assert found.balanced == (removed is None)


@pytest.mark.parametrize("removed", [1, 4, 9])
@pytest.mark.parametrize("ahead_s", [0.6, -0.6])
def test_the_difference_of_two_utcs_changes_nothing(
    fly: Callable[..., Path], bin_log: Path, removed: int, ahead_s: float
) -> None:
    """UTC says whose log it is; the log is placed by the time since boot."""
    add_triggers(bin_log, TIMES_S)
    kept = {number: t_s for number, t_s in TIMES_S.items() if number != removed}
    flight = fly(requested(kept, "DO_DIGICAM_CONTROL", numbers=False), ahead_s=ahead_s)
    (one,) = three_books.reconcile(flight, [bin_log]).imbalances
    assert (one.kind, one.number, one.instead) == ("lost", removed, ())


@pytest.mark.parametrize(
    ("late_s", "time_delays_s"), [(0.3, (0.0,)), (0.0, (0.3,)), (0.0, (0.0, 0.3, 0.4)), (0.0, (0.1, 0.45))]
)
def test_the_one_lost_between_others_is_named_over_links_that_delay(
    fly: Callable[..., Path], bin_log: Path, late_s: float, time_delays_s: Sequence[float]
) -> None:
    """More than half of the interval: its neighbour was named, and one that was taken was doubled."""
    add_triggers(bin_log, TIMES_S)
    late = {number: t_s + late_s for number, t_s in TIMES_S.items() if number != 4}
    flight = fly(requested(late, "DO_DIGICAM_CONTROL", numbers=False), time_delays_s=time_delays_s)
    (one,) = three_books.reconcile(flight, [bin_log]).imbalances
    assert (one.kind, one.number, one.instead) == ("lost", 4, ())
    flight = fly(requested(late), time_delays_s=time_delays_s)
    (one,) = three_books.reconcile(flight, [bin_log]).imbalances
    assert (one.kind, one.number, one.instead) == ("lost", 4, ())


@pytest.mark.parametrize("removed", [1, 9])
def test_where_time_can_t_tell_the_report_names_both(
    fly: Callable[..., Path], bin_log: Path, removed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """All 0.3 s late at 0.5 s; all 0.2 s early say the same but for the ends."""
    add_triggers(bin_log, TIMES_S)
    late = {number: t_s + 0.3 for number, t_s in TIMES_S.items() if number != removed}
    flight = fly(requested(late, "DO_DIGICAM_CONTROL", numbers=False), failed=(3,))
    code, said = report(capsys, flight, "--log", bin_log)
    assert code == 1
    lost = next(line for line in said if line.startswith("lost"))
    assert lost.startswith(("lost: trigger 1 or 9 at ", "lost: trigger 9 or 1 at "))
    fileless = next(line for line in said if line.startswith("without a file"))
    numbers = sorted(int(word) for word in fileless.partition(" (")[0].split() if word.isdigit())
    assert numbers == [4, 5]
    assert said[-1] == "THE THREE BOOKS DO NOT BALANCE: 1 lost, 1 without a file"
    flight = fly(requested(late))
    (one,) = three_books.reconcile(flight, [bin_log]).imbalances
    assert (one.number, one.instead) == (removed, ())


@pytest.mark.parametrize("fired_by", ["", "outside"])
def test_requests_that_a_link_has_held_are_late_unless_the_autopilot_fires_the_camera(
    fly: Callable[..., Path], bin_log: Path, fired_by: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """3 to 7 came together when the link delivered at 5.1 s: five photographs of one place, and the books balanced."""
    add_triggers(bin_log, TIMES_S)
    held = {number: 5.1 + number / 1e3 if 3 <= number <= 7 else t_s for number, t_s in TIMES_S.items()}
    shots = requested(held, "CAMERA_FEEDBACK" if fired_by else "IMAGE_START_CAPTURE")
    code, said = report(capsys, fly(shots, fired_by=fired_by), "--log", bin_log)
    late = [line.split()[2] for line in said if line.startswith("late: trigger")]
    assert (code, late) == ((0, []) if fired_by else (1, ["3", "4", "5", "6", "7"]))
    if not fired_by:
        assert any("its request came 3.1 s late" in line for line in said)
        assert said[-1] == "THE THREE BOOKS DO NOT BALANCE: 5 late"


def test_a_long_row_of_triggers_in_doubt_is_counted() -> None:
    unheard = finding(Code.TRIGGER_UNHEARD, Subject("trigger", 12))
    one = three_books.Imbalance("lost", 12, (), None, None, unheard, (9, 10, 11, 13, 14))
    assert one.text() == f"lost: trigger 12 or one of 5 others from 9 to 14: {text(unheard)}"
    one = three_books.Imbalance("phantom", None, (4,), None, None, unheard, (5,))
    assert one.text() == f"phantom: shot 4 or 5: {text(unheard)}"


def test_a_stations_request_that_the_autopilot_executed_is_its_trigger(fly: Callable[..., Path], bin_log: Path) -> None:
    """And one that a station sent to the camera alone is nobody else's."""
    add_triggers(bin_log, TIMES_S)
    shots = [*requested(), (5.6, STATION, "IMAGE_START_CAPTURE", 0)]
    shots[2] = (TIMES_S[3] - 0.021, STATION, "DO_DIGICAM_CONTROL", None)
    assert three_books.reconcile(fly(shots), [bin_log]).balanced


def test_a_number_that_neither_the_log_nor_a_shot_has_is_lost(fly: Callable[..., Path], bin_log: Path) -> None:
    kept = {number: t_s for number, t_s in TIMES_S.items() if number not in (4, 5)}
    add_triggers(bin_log, kept)
    found = three_books.reconcile(fly(requested(kept)), [bin_log])
    assert [(one.kind, one.number) for one in found.imbalances] == [("lost", 4), ("lost", 5)]
    assert not found.balanced


def test_with_a_pin_triggers_are_trig_and_contacts_are_counted(
    fly: Callable[..., Path], bin_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_triggers(bin_log, TIMES_S, "TRIG")
    add_triggers(bin_log, {number: t_s + 0.06 for number, t_s in TIMES_S.items() if number != 9})
    code, said = report(capsys, fly(requested()), "--log", bin_log)
    assert code == 0
    assert "9 triggers in ArduPilot's 00000012.bin (8 contacts at its feedback pin)" in said[-2]


@pytest.mark.parametrize(("camera", "kind"), [(0, "refused"), (1, "lost")])
def test_a_report_about_another_camera_is_no_request_to_this_one(
    fly: Callable[..., Path], bin_log: Path, camera: int, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trigger 3 made no shot, of a camera that is fired outside and told of it; one camera's report of it was heard."""
    add_triggers(bin_log, TIMES_S)
    shots = [one for one in requested(kind="CAMERA_FEEDBACK") if one[3] != 3]
    flight = fly(shots, fired_by="outside", fed_back=[(TIMES_S[3], 3, camera)])
    _, said = report(capsys, flight, "--log", bin_log, "--json")
    assert [one["kind"] for one in json.loads("\n".join(said))["log"]["imbalances"]] == [kind]


@pytest.mark.parametrize("removed", [None, 4])
def test_the_log_of_px4_with_contacts_alone(fly: Callable[..., Path], tmp_path: Path, removed: int | None) -> None:
    """TRIG_MODE 0 with CAM_CAP_FBACK: something else fires, and each contact is one photograph."""
    pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    log = ulog_written(tmp_path)
    add_px4_triggers(log, TIMES_S, contacts=True)
    shots = requested({number: t_s for number, t_s in TIMES_S.items() if number != removed}, "CAMERA_IMAGE_CAPTURED")
    found = three_books.reconcile(fly(shots, fired_by="outside"), [log])
    assert [(one.kind, one.number) for one in found.imbalances] == ([("lost", removed)] if removed else [])
    assert (found.triggers, found.contacts, found.shots) == (9, 9, 9 - bool(removed))


@pytest.mark.parametrize("rewritten", [False, True])
@pytest.mark.parametrize("removed", [None, 4])
def test_the_log_of_px4(fly: Callable[..., Path], tmp_path: Path, removed: int | None, rewritten: bool) -> None:
    """Its trigger's number is in CAMERA_TRIGGER; `rewritten` as pyulog writes it."""
    pyulog = pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    log = ulog_written(tmp_path)
    add_px4_triggers(log, TIMES_S)
    add_px4_triggers(log, {number: t_s + 0.06 for number, t_s in TIMES_S.items()}, contacts=True)
    if rewritten:
        pyulog.ULog(str(log)).write_ulog(str(tmp_path / "again.ulg"))
        log = tmp_path / "again.ulg"
    shots = requested({number: t_s for number, t_s in TIMES_S.items() if number != removed}, "CAMERA_TRIGGER")
    shots[0] = (TIMES_S[1], OWN, "IMAGE_START_CAPTURE", 77)  # of its link, not of the trigger
    found = three_books.reconcile(fly(shots), [log])
    assert [(one.kind, one.number) for one in found.imbalances] == ([("lost", removed)] if removed else [])
    assert (found.triggers, found.contacts, found.by) == (9, 9, "PX4")
    if removed:
        assert found.imbalances[0].place == pytest.approx(
            (FlightPath(5).pose(TIMES_S[removed]).latitude_deg, FlightPath(5).pose(TIMES_S[removed]).longitude_deg),
            abs=1e-6,
        )


def test_shots_beyond_a_log_that_was_cut_off_are_not_judged(
    fly: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log ends at 6 s, in the middle of a message; two shots follow."""
    log, _ = written(tmp_path)
    add_triggers(log, TIMES_S)
    log.write_bytes(log.read_bytes()[:-9])  # of trigger 9
    flight = fly(requested({**TIMES_S, 10: 8.7, 11: 9.2}), ends_s=10.0)
    code, said = report(capsys, flight, "--log", log)
    assert code == 1
    assert "not judged: 2 shots (shots 9 to 10) at times that the log does not hold" in said
    assert sum(line.startswith("phantom") for line in said) == 1
    assert said[-1] == "THE THREE BOOKS DO NOT BALANCE: 1 phantom, 2 not judged"


def test_triggers_after_the_flight_are_counted_and_not_lost(fly: Callable[..., Path], bin_log: Path) -> None:
    add_triggers(bin_log, TIMES_S)
    found = three_books.reconcile(fly(requested({1: TIMES_S[1], 2: TIMES_S[2]}), ends_s=1.9), [bin_log])
    assert (found.triggers, found.elsewhere, found.balanced) == (2, 7, True)


@pytest.mark.parametrize("lost", [(), (2, 7), (3, 4)])
def test_each_trigger_around_a_restart_is_in_the_book_of_its_power_up(
    fly: Callable[..., Path], bin_log: Path, tmp_path: Path, lost: tuple[int, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """The autopilot crashed after four triggers and counted from 1 again within seconds: the second 1 to 4 seemed to be
    the first ones again. Lost on the link are the triggers `lost`, of all nine."""
    (tmp_path / "again").mkdir()

    def later(name: str, row: Row) -> list[tuple[str, Row]]:
        return [(name, (row[0] - AGAIN_US, *row[1:]))] if row[0] >= AGAIN_US else []

    again = rewritten(written(tmp_path / "again")[0], later)
    add_triggers(bin_log, {number: TIMES_S[number] for number in range(1, 5)})
    add_triggers(again, {number - 4: TIMES_S[number] - AGAIN_US / 1e6 for number in range(5, 10)})
    shots = [
        (t_s, OWN, "IMAGE_START_CAPTURE", number if number < 5 else number - 4)
        for number, t_s in TIMES_S.items()
        if number not in lost
    ]
    flight = fly(shots, again_s=2.7)
    code, said = report(capsys, flight, "--log", bin_log, "--log", again)
    named = [line.split(" at ")[0] for line in said if line.startswith(("lost", "doubled", "phantom", "refused"))]
    assert named == [f"lost: trigger {number if number < 5 else number - 4}" for number in lost]
    assert code == bool(lost)


def test_a_log_of_another_start_is_refused(
    fly: Callable[..., Path], bin_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_triggers(bin_log, TIMES_S)
    flight = fly(requested(), late_s=86_400.0)
    assert main(["flight", "report", str(flight), "--log", str(bin_log)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "00000012.bin is not a log of this flight: its autopilot was started at 2026-11-21T10:14:5" in error
    assert "that of the flight at 2026-11-22T10:14:5" in error


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.bin", b"nothing of the kind", "is no log of an autopilot"),
        ("a.bin", None, "can't be read"),
        ("a.bin", b"\xa3\x95\x80\x80" + bytes(400), "no fix|damaged"),
        ("a.ulg", b"ULog\x01\x12\x35\x01" + bytes(400), "damaged|no messages"),
    ],
)
def test_a_file_that_is_no_sound_log_is_one_sentence(
    fly: Callable[..., Path], tmp_path: Path, name: str, data: bytes | None, says: str
) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises((DappledError, DappledError, AutopilotLogError), match=says):
        three_books.reconcile(fly(requested()), [tmp_path / name])


@pytest.mark.parametrize("form", ["bin", "ulg"])
def test_a_log_without_a_trigger_is_in_doubt_and_says_what_to_set(
    fly: Callable[..., Path], tmp_path: Path, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was an error instead of a report. A station's own shots need no trigger, but the log proves nothing."""
    if form == "ulg":
        pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    log = written(tmp_path)[0] if form == "bin" else ulog_written(tmp_path)
    code, said = report(capsys, fly(requested()), "--log", log)
    assert code == 1
    assert "not judged: 9 shots (shots 0 to 8) at times that the log does not hold" in said
    assert said[-1] == "the three books can't be compared"
    flight = fly([(t_s, STATION, "IMAGE_START_CAPTURE", 0) for t_s in TIMES_S.values()])
    assert main(["flight", "report", str(flight), "--log", str(log)]) == 1
    (doubt,) = capsys.readouterr().err.splitlines()
    records = "CAM or TRIG of CAM1" if form == "bin" else "camera_trigger or camera_capture"
    assert doubt.startswith(f"in doubt: log {log.name}: it holds no trigger ({records}): none was given, or they were")
    assert "LOG_BITMASK" in doubt


def test_beside_a_log_with_triggers_one_without_is_of_a_start_in_which_none_was_given(
    fly: Callable[..., Path], bin_log: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    other, _ = written(tmp_path / "other")
    add_triggers(bin_log, TIMES_S)
    assert three_books.reconcile(fly(requested()), [other, bin_log]).balanced


@pytest.mark.parametrize(  # both readers run in processes of their own, which take their time to begin
    ("kind", "count"),
    [
        ("bin", 3),
        ("ulg", 3),
        *(pytest.param(kind, 150, marks=pytest.mark.long) for kind in ("bin", "ulg")),
    ],
)
def test_a_damaged_log_is_read_or_refused(
    tmp_path: Path, kind: str, count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bytes changed anywhere, also in the descriptions of messages, raise nothing else; nothing is printed."""
    if kind == "ulg":
        pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    log = written(tmp_path)[0] if kind == "bin" else ulog_written(tmp_path)
    (add_triggers if kind == "bin" else add_px4_triggers)(log, TIMES_S)
    whole, places = log.read_bytes(), random.Random(1)  # noqa: S311
    for _ in range(count):
        data = bytearray(whole)
        for _ in range(places.choice((1, 5, 50))):
            data[places.randrange(places.choice((1200, len(data))))] = places.randrange(256)
        log.write_bytes(data)
        with contextlib.suppress(AutopilotLogError):
            read = dataflash.triggers(log, 0) if kind == "bin" else ulog.triggers(log)
            assert read.begins_us <= read.ends_us
    assert not capsys.readouterr().out
