"""A flight's beginning and end, what a crash leaves behind, the index over flights, and the lock."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.findings import Code, Subject, finding, told
from dappled.flight import (
    FlightError,
    ImageIndex,
    LedgerReader,
    Recording,
    Stray,
    flight_report,
    layout,
    log_reading,
    logs,
    recording,
    recovery,
)
from dappled.flight.checks.flight_check import check
from dappled.flight.index import IndexEntry, in_order
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, held, logged, mavlink_1, mavlink_2, request, shot

LATER_UTC_NS = START_UTC_NS + 60_000_000_000


def crash(flight: Recording) -> None:
    """Leave the flight as a killed process leaves it: descriptors closed by the system, nothing said."""
    flight._ended.set()
    flight.journal.close()
    flight.telemetry.close()
    flight.ledger.close()
    flight.index.close()
    flight._lock.close()


def begin_later(flights: Path) -> Recording:
    return recording.begin(flights, RecordedClock(LATER_UTC_NS))


def test_a_flight_from_first_to_last(flights: Path, flight: Recording) -> None:
    assert (flight.next_index, flight.recovered) == (0, ())
    request(flight, 0)
    frame = deliver(flight, 0, b"raw")
    flight.note_image(0)
    flight.note_image(99)  # a shot that was never requested has no entry
    assert flight.index.lookup(0) == IndexEntry(0, flight.folder.name, frame.name, "safe")
    assert flight.index.lookup(99) is None
    flight.telemetry.append(1, mavlink_1(b"a"))
    flight.add_facts({"identity": {"model": "450D"}})
    assert layout.read_facts(flight.folder) == {"camera": {"driver": "none"}, "identity": {"model": "450D"}}
    assert flight.close() == []
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert ledger.facts()["telemetry_packets"] == 1
        assert ledger.facts()["closed_utc_ns"] == START_UTC_NS
    assert sorted(os.listdir(flight.folder.path)) == [
        "flight.sqlite",
        "flight.toml",
        "frames",
        "seals.jsonl",
        "shots.jsonl",
        "telemetry.tlog",
    ]
    report = check(flight.folder.path)
    assert (report.intact, report.files, report.size, report.telemetry_packets) == (True, 1, 3, 1)

    second = begin_later(flights)
    assert (second.next_index, second.recovered) == (1, ())
    assert second.index.lookup(0) == IndexEntry(0, flight.folder.name, frame.name, "safe")
    assert list(second.index.flights().values()) == [START_UTC_NS, LATER_UTC_NS]
    second.close()


def test_closing_fails_what_is_open(flight: Recording) -> None:
    request(flight, 0)
    flight.journal.note(shot(1))
    assert [(one.code, dict(one.facts)) for one in flight.close()] == [
        (Code.SHOT_ENTERED, {"shot": 1}),
        (Code.SHOT_LOST, {"shot": 0, "state": "fired"}),
        (Code.SHOT_LOST, {"shot": 1, "state": "wished"}),
    ]
    assert check(flight.folder.path).problems == ()


def test_a_crash_is_put_in_order_before_the_next_flight(flights: Path, flight: Recording) -> None:
    for index in range(3):
        request(flight, index)
    deliver(flight, 0, b"safe")
    frames = flight.folder.frames
    (frames / "000001.cr2").write_bytes(b"whole, but the row was never written")
    (frames / ".000002.cr2.part").write_bytes(b"half")
    (frames / "000007.cr2").write_bytes(b"nobody's")
    (frames / "000000.cr2.xmp").write_text("a sidecar")
    flight.journal.note(shot(3))
    flight.telemetry.append(1, mavlink_2(b"a"))
    crash(flight)
    with flight.folder.journal.open("ab") as file:
        file.write(b'{"cause"')
    with flight.folder.telemetry.open("ab") as file:
        file.write(logged(2, mavlink_2(b"b"))[:-3])

    second = begin_later(flights)
    said = "\n".join(str(told(one)) for one in second.recovered)
    for words in (
        "the half-written file .000002.cr2.part was removed",
        "the last line of",
        "shot 3 was noted in the journal only",
        "frames/000001.cr2 was complete but had no row; it is adopted as the frame of shot 1",
        "frames/000007.cr2 belongs to no shot",
        "shot 2 was fired, and is lost",
        "shot 3 was wished, and is lost",
        "18 bytes at the end are not telemetry",
        "it was not closed; it is now",
    ):
        assert words in said
    assert second.next_index == 8  # beyond the stray's number
    assert [event.finding for event in second.ledger.events()] == list(second.recovered)
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert [row.state for row in ledger.shots()] == ["safe", "safe", "failed", "failed"]
        assert [frame.name for frame in ledger.frames()] == ["frames/000000.cr2", "frames/000001.cr2"]
        assert [stray.name for stray in ledger.strays()] == ["frames/000007.cr2"]
    assert check(flight.folder.path).problems == ()
    again = recovery.recover_flight(flight.folder, RecordedClock(LATER_UTC_NS))
    assert [one.code for one in again] == [Code.JOURNAL_TORN]
    second.close()
    third = begin_later(flights)
    assert third.recovered == ()
    third.close()


def test_the_report_of_a_flight_that_was_cut_short_says_what_it_can_not_know(
    flights: Path, flight: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    """The journal's last lines and counted refusals go with the power; it said that the counts agree."""
    request(flight, 0)
    deliver(flight, 0, b"raw")
    crash(flight)
    begin_later(flights).close()
    path = str(flight.folder.path)
    balance = flight_report.balance(flight.folder.path)
    assert balance.balanced
    assert balance.cut_short == finding(Code.FLIGHT_CUT_SHORT, Subject("flight"), shots_s=1.0, refusals_s=6.0)
    assert main(["flight", "report", path]) == 1
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "what is recorded adds up; what came last is not known"
    assert "shots accepted in its last 1 s, and requests refused in its last 6 s, may be missing" in said.err
    assert main(["flight", "report", path, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["balanced"] is None


def test_a_shot_that_only_the_ledger_kept_is_noted_again(flights: Path, flight: Recording) -> None:
    request(flight, 0)
    crash(flight)
    flight.folder.journal.write_bytes(b'{"torn')  # a power cut took what was not flushed
    begin_later(flights).close()
    assert log_reading.read_journal(flight.folder.journal).shots == (shot(0),)
    assert check(flight.folder.path).problems == ()


def test_a_flight_that_died_while_it_was_made(flights: Path) -> None:
    folder = layout.create(flights, START_UTC_NS)
    second = begin_later(flights)
    assert second.recovered == (finding(Code.FLIGHT_PUT_RIGHT, Subject("flight", folder.name)),)
    assert check(folder.path).problems == ()
    second.close()


def test_the_names_in_a_new_flight_are_sure_when_it_begins(
    flights: Path, synced: list[tuple[Path, frozenset[str]]]
) -> None:
    """The ledger, the telemetry and the journal: a power cut may keep bytes and lose the name that leads to them."""
    flight = begin_later(flights)
    begun = {flight.folder.ledger.name, flight.folder.telemetry.name, flight.folder.journal.name}
    assert any(path == flight.folder.path and begun <= names for path, names in synced)
    flight.close()


def test_a_damaged_ledger_does_not_keep_the_next_flight_down(
    flights: Path, flight: Recording, synced: list[tuple[Path, frozenset[str]]]
) -> None:
    request(flight, 4)
    deliver(flight, 4, b"raw")
    flight.close()
    (flights / "index.sqlite").unlink()
    flight.folder.ledger.write_bytes(b"damage" * 1000)
    second = begin_later(flights)
    assert second.next_index == 5  # the journal and the frame's name say so
    assert second.recovered[0].code is Code.LEDGER_REBUILT
    ledger = flight.folder.ledger.name
    aside = [names for path, names in synced if path == flight.folder.path and ledger not in names]
    assert any(f"{ledger}.damaged" in names for names in aside)  # sure before another one is made
    assert (flight.folder.path / "frames/000004.cr2").read_bytes() == b"raw"
    second.close()


@pytest.mark.parametrize("raw", ["DSCF0001.RAF", "IMG_0001.CR2"])
def test_a_ledger_made_anew_tells_raw_frames_from_the_jpegs_beside_them(
    flights: Path, flight: Recording, raw: str
) -> None:
    request(flight, 4)
    frame = deliver(flight, 4, b"raw", raw)
    with held(b"jpeg") as blob:
        flight.recorder.record_companion(4, "DSCF0001.JPG", blob, arrived_utc_ns=6)
    flight.close()
    (flights / "index.sqlite").unlink()
    flight.folder.ledger.write_bytes(b"damage" * 1000)
    begin_later(flights).close()
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert [one.name for one in ledger.frames()] == [frame.name]
        assert [one.name for one in ledger.companions()] == ["frames/000004.jpg"]
        assert ledger.strays() == []


@pytest.mark.parametrize("harm", ["garbage", "foreign", "gone"])
def test_the_index_is_made_anew_from_the_flights(flights: Path, flight: Recording, harm: str) -> None:
    request(flight, 0)
    frame = deliver(flight, 0, b"raw")
    flight.close()
    path = flights / "index.sqlite"
    if harm == "garbage":
        path.write_bytes(b"garbage" * 1000)
    else:
        path.unlink()
        if harm == "foreign":
            db = sqlite3.connect(path)
            db.execute("CREATE TABLE other (a)")
            db.close()
    second = begin_later(flights)
    moved = [one.facts["aside"] for one in second.recovered if one.code is Code.INDEX_REBUILT]
    assert moved == ([] if harm == "gone" else ["index.sqlite.damaged"])
    assert second.index.lookup(0) == IndexEntry(0, flight.folder.name, frame.name, "safe")
    assert second.next_index == 1
    second.close()


def test_an_image_index_in_two_flights_is_told_and_the_first_counts(flights: Path) -> None:
    flights.mkdir()
    with ImageIndex(flights) as index:
        for name in ("a", "b"):
            index.add_flight(name, None)
        index.put(IndexEntry(1, "a", None, "failed"))
        with pytest.raises(FlightError, match="image 1 is in flight a and again in b"):
            index.put(IndexEntry(1, "b", None, "failed"))
        index.add_flight("a", 5)  # UTC was learnt
        index.add_flight("a", None)
        assert index.flights() == {"a": 5, "b": None}


def test_the_next_index_is_beyond_all_that_an_unindexed_flight_mentions(flights: Path) -> None:
    flights.mkdir()
    with ImageIndex(flights) as index:
        assert index.next_index() == 0
        index.add_flight("a", None)
        index.put(IndexEntry(10, "a", None, "failed"))
        assert index.next_index() == 11
        folder = layout.create(flights, START_UTC_NS)
        journal = logs.ShotJournal(folder.journal)
        journal.note(shot(20))
        journal.close()
        assert index.next_index() == 21
        (folder.frames / "000030.dng").write_bytes(b"x")
        assert index.next_index() == 31


def test_two_daemons_in_one_folder(flights: Path, flight: Recording) -> None:
    with pytest.raises(FlightError, match=rf"another dappled \(process {os.getpid()}\) records into .*; stop it"):
        begin_later(flights)
    assert layout.is_locked(flights)
    code = (
        "from dappled.clock import SystemClock; from dappled.flight import recording; from pathlib import Path; "
        f"recording.begin(Path({str(flights)!r}), SystemClock())"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert "another dappled" in other.stderr
    flight.close()
    assert not layout.is_locked(flights)
    assert not layout.is_locked(flights / "missing")
    begin_later(flights).close()


@pytest.mark.parametrize("at", [(layout, "create"), (recording, "Recorder")])
def test_a_beginning_that_fails_leaves_no_lock_no_flight_and_no_thread(
    flights: Path, monkeypatch: pytest.MonkeyPatch, at: tuple[ModuleType, str]
) -> None:
    def refuse(*_: object) -> None:
        raise FlightError("no")

    monkeypatch.setattr(*at, refuse)
    threads = set(threading.enumerate())
    with pytest.raises(FlightError, match="no"):
        recording.begin(flights, RecordedClock(START_UTC_NS))
    assert not layout.is_locked(flights)
    assert layout.flights(flights) == []
    assert set(threading.enumerate()) <= threads


def test_a_file_in_place_of_the_flights_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FlightError, match=r"not a folder|in the way"):
        recording.begin(tmp_path / "file", RecordedClock(START_UTC_NS))


def test_strays_are_told_apart_from_what_is_adopted(flights: Path, flight: Recording) -> None:
    (flight.folder.frames / "stray-000000.jpg").write_bytes(b"ab")
    crash(flight)
    begin_later(flights).close()
    with LedgerReader.open(flight.folder.ledger) as ledger:
        (stray,) = ledger.strays()
        assert isinstance(stray, Stray)
        assert stray.size == 2


def test_a_flight_without_utc_is_named_by_boot_and_put_right_later(flights: Path) -> None:
    uptime_ns = 60 * 10**9  # this machine thinks that it is 1970
    flight = recording.begin(flights, RecordedClock(uptime_ns), utc_known=False)
    name = flight.folder.name
    assert name.startswith("boot")
    request(flight, 0)
    frame = deliver(flight, 0, b"raw")
    flight.note_image(0)
    assert flight.index.flights() == {name: None}
    assert flight.ledger.utc_correction_ns() is None
    correction_ns = START_UTC_NS - uptime_ns
    flight.learn_utc(correction_ns, 10**6, "SYSTEM_TIME")
    assert flight.index.flights() == {name: START_UTC_NS}
    flight.close()
    assert flight.folder.path.name == name
    (flights / "index.sqlite").unlink()  # the ledger knows it too
    second = begin_later(flights)
    assert second.index.flights() == {name: START_UTC_NS, second.folder.name: LATER_UTC_NS}
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert ledger.utc_correction_ns() == correction_ns
    assert second.ledger.utc_correction_ns() == 0
    assert second.index.lookup(0) == IndexEntry(0, name, frame.name, "safe")
    second.close()
    assert flight_report.balance(flight.folder.path).began_utc_ns == START_UTC_NS
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert [event.kind for event in ledger.events()] == ["utc"]


def test_a_flight_that_never_learnt_utc_says_so(flights: Path) -> None:
    flight = recording.begin(flights, RecordedClock(5), utc_known=False)
    flight.close()
    assert flight_report.balance(flight.folder.path).began_utc_ns is None
    assert flight_report.show(flight.folder.path).utc_correction_ns is None
    assert check(flight.folder.path).problems == ()


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_flights_stand_in_the_order_they_were_flown_when_the_clock_was_stepped(flights: Path, step_s: int) -> None:
    """The image index goes on, and the last flight is the last one flown."""
    names = []
    for number in range(3):
        begun = recording.begin(flights, RecordedClock(START_UTC_NS + number * step_s * 10**9))
        request(begun, begun.next_index)
        deliver(begun, begun.next_index, b"raw")
        begun.close()
        names.append(begun.folder.name)
    assert [folder.name for folder in in_order(flights)] == names
    (flights / "index.sqlite").write_bytes(b"damaged")
    assert sorted(names) == [folder.name for folder in in_order(flights)]
    last = begin_later(flights)
    assert last.next_index == 3
    last.close()
