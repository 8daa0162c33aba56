from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from dappled import durable
from dappled.cli.flight import lines as flight_lines
from dappled.clock import SystemClock
from dappled.findings import Code, Subject, finding
from dappled.flight import FlightError, FlightFolder, Ledger, LedgerReader, Recording, Result, flight_report
from dappled.flight.checks.flight_check import check
from dappled.flight.records import LOST
from tests.flight.makers import deliver, flip, mavlink_2, request, shot, tag, words_of
from tests.standing import failure


@pytest.fixture(scope="module")
def made(begun: Recording) -> FlightFolder:
    """A closed flight: shots 0 and 1 safe, tagged and (0) decoded, shot 2 failed."""
    for index in range(3):
        request(begun, index)
    for index in range(2):
        frame = deliver(begun, index, bytes(1000))
        begun.ledger.add_tag(tag(frame))
    begun.ledger.add_result(Result(0, "ab", 12, 13, "geometric", "predicted"))
    begun.ledger.failed(2, failure("no file came"))
    for number in range(20):
        begun.telemetry.append(number, mavlink_2(b"payload"))
    (begun.folder.path / "inputs/masks").mkdir(parents=True)
    for name in ("white.npy", "masks/mask-1.toml"):
        (begun.folder.path / "inputs" / name).write_bytes(b"what frames were decoded with")
    begun.note_inputs("inputs")
    begun.add_facts({"identity": {"model": "450D"}})
    begun.close()
    return begun.folder


def alter(folder: FlightFolder, sql: str) -> None:
    db = sqlite3.connect(folder.ledger)
    db.execute(sql)
    db.commit()
    db.close()


def drop_line(path: Path, number: int) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:number] + lines[number + 1 :]))


@dataclass(frozen=True)
class Fault:
    name: str
    do: Callable[[FlightFolder], object]
    words: str


FAULTS = [
    Fault("a byte of a frame", lambda f: flip(f.frames / "000001.cr2", 500), "000001.cr2 was changed"),
    Fault(
        "a shorter frame", lambda f: (f.frames / "000001.cr2").write_bytes(b"x"), "has 1 bytes, the ledger says 1000"
    ),
    Fault("no frame", lambda f: (f.frames / "000001.cr2").unlink(), "the file is missing"),
    Fault("one file more", lambda f: (f.frames / "000009.cr2").write_bytes(b"x"), "in no row"),
    Fault("half a file", lambda f: (f.frames / ".a.part").write_bytes(b"x"), "half-written"),
    Fault("a byte of telemetry", lambda f: flip(f.telemetry, 20), "telemetry.tlog was changed"),
    Fault("no telemetry", lambda f: f.telemetry.unlink(), "telemetry.tlog is missing"),
    Fault("no journal", lambda f: f.journal.unlink(), "not in shots.jsonl"),
    Fault(
        "a line of the journal", lambda f: drop_line(f.journal, 1), "shot 1 is in the ledger, but not in shots.jsonl"
    ),
    Fault(
        "another shot",
        lambda f: f.journal.write_bytes(f.journal.read_bytes().replace(b"mavlink:255/190", b"mavlink:255/191")),
        "differs between shots.jsonl",
    ),
    Fault("a letter of flight.toml", lambda f: flip(f.settings, 2), "flight.toml was changed"),
    Fault("a byte of the white frame", lambda f: flip(f.path / "inputs/white.npy", 9), "inputs/white.npy was changed"),
    Fault(
        "no mask profile", lambda f: (f.path / "inputs/masks/mask-1.toml").unlink(), "mask-1.toml is in the ledger, but"
    ),
    Fault("no flight.toml", lambda f: f.settings.unlink(), "flight.toml"),
    Fault("no ledger", lambda f: f.ledger.unlink(), "there is no ledger"),
    Fault("garbage for a ledger", lambda f: f.ledger.write_bytes(b"garbage" * 999), "damaged"),
    Fault(
        "a shot less", lambda f: alter(f, "DELETE FROM shots WHERE idx = 2"), "in shots.jsonl, but not in the ledger"
    ),
    Fault("a state", lambda f: alter(f, "UPDATE shots SET state = 'failed' WHERE idx = 1"), "has a frame for it"),
    Fault("a frame's row", lambda f: alter(f, "UPDATE shots SET state = 'safe' WHERE idx = 2"), "has no frame for it"),
    Fault("a pose", lambda f: alter(f, "UPDATE poses SET record = record || ' '"), "the pose of frame 0 was changed"),
    Fault("a tag", lambda f: alter(f, "UPDATE tags SET record = record || ' '"), "the tag of frame 1 was changed"),
    Fault("a result", lambda f: alter(f, "UPDATE results SET slices_sha256 = 'cd'"), "two different hashes"),
    Fault("a tag's text", lambda f: alter(f, "UPDATE tags SET record = '[]'"), "can't be read"),
    Fault("a hash", lambda f: alter(f, "UPDATE frames SET sha256 = 'x' WHERE idx = 0"), "about other bytes"),
    Fault("its end", lambda f: alter(f, "DELETE FROM facts WHERE key = 'closed_utc_ns'"), "never closed"),
]


def test_a_flight_as_it_was_recorded_is_intact(recorded: FlightFolder) -> None:
    report = check(recorded.path)
    assert report.intact
    assert (report.files, report.size, report.telemetry_packets, words_of(report.notes)) == (2, 2000, 20, ())


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_one_fault_is_found(recorded: FlightFolder, fault: Fault) -> None:
    fault.do(recorded)
    report = check(recorded.path)
    assert not report.intact
    assert any(fault.words in problem for problem in words_of(report.problems)), words_of(report.problems)


def test_a_flight_that_is_being_recorded_is_no_fault(flight: Recording) -> None:
    request(flight, 0)
    report = check(flight.folder.path)
    assert report.intact
    assert "still being recorded" in words_of(report.notes)[0]


def test_a_crash_while_flight_toml_is_written_anew_is_no_fault(
    flight: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(path: Path, data: bytes) -> None:
        if written:
            write(path, data)
        raise KeyboardInterrupt

    write = durable.write_file
    for written in (False, True):
        with monkeypatch.context() as dying:
            dying.setattr(durable, "write_file", crash)
            with pytest.raises(KeyboardInterrupt):
                flight.add_facts({"camera": {"written": written}})
        assert words_of(check(flight.folder.path).problems) == ()
    flight.add_facts({"identity": {"model": "450D"}})
    with LedgerReader.open(flight.folder.ledger) as ledger:
        assert len(ledger.facts()["sha256:flight.toml"]) == 1


def test_what_is_no_flight_is_told(tmp_path: Path) -> None:
    for ask in (check, flight_report.balance, flight_report.show):
        with pytest.raises(FlightError, match="not a flight folder"):
            ask(tmp_path)


def test_the_counts_balance(recorded: FlightFolder) -> None:
    counts = flight_report.balance(recorded.path)
    assert (counts.wishes, counts.safe, counts.failed, counts.open) == (3, 2, 1, 0)
    assert (counts.frames, counts.tagged, counts.decoded, counts.strays, counts.size) == (2, 2, 1, 0, 2000)
    assert counts.by_source == {"mavlink:255/190": 3}
    assert counts.closed
    assert counts.balanced
    alter(recorded, "UPDATE shots SET state = 'fired' WHERE idx = 2")
    assert not flight_report.balance(recorded.path).balanced


def test_counts_with_lost_triggers_do_not_balance(recorded: FlightFolder) -> None:
    where = "noticed at 2026-11-21T10:15:03.2Z near 47.397700, 8.545600"
    lost = finding(Code.TRIGGER_LOST, Subject("trigger", "13 to 15"), first=13, triggers=3, where=where)
    with Ledger(recorded.ledger, SystemClock()) as ledger:
        ledger.add_event(LOST, lost)
    counts = flight_report.balance(recorded.path)
    assert (counts.lost, counts.lost_triggers) == (3, (lost,))
    assert not counts.balanced
    lines = list(flight_lines.of_report(counts, ()))
    assert lines[-2:] == [
        f"lost: trigger 13 to 15: became no shot, {where}",
        "THE COUNTS DO NOT AGREE: 3 triggers of the autopilot became no shot",
    ]


def test_a_flight_is_shown_line_by_line(recorded: FlightFolder) -> None:
    shown = flight_report.show(recorded.path)
    assert [line.row.shot for line in shown.lines] == [shot(0), shot(1), shot(2)]
    assert [line.row.state for line in shown.lines] == ["safe", "safe", "failed"]
    assert [line.result is not None for line in shown.lines] == [True, False, False]
    assert shown.lines[2].frame is None
    assert shown.settings["camera"] == {"driver": "none"}
    assert shown.facts["telemetry_packets"] == 20


def test_a_flight_under_another_name_is_listed_and_what_is_no_flight_is_not(recorded: FlightFolder) -> None:
    renamed = recorded.path.rename(recorded.path.with_name("first field"))
    (beside := renamed.with_name("pictures")).mkdir()
    (making := renamed.with_name(".made.part")).mkdir()
    (making / "flight.toml").write_bytes(b"")
    (beside / "frame.dng").write_bytes(b"")
    (listed,) = flight_report.list_flights(renamed.parent)
    assert (listed.path, listed.problem) == (renamed, None)
    assert listed.balance == flight_report.balance(renamed)


def test_flights_are_listed_with_what_is_wrong(recorded: FlightFolder) -> None:
    (other := recorded.path.with_name("20260101T000000Z-00000000")).mkdir()
    listed = flight_report.list_flights(recorded.path.parent)
    assert [each.name for each in listed] == [other.name, recorded.name]
    assert listed[0].problem is not None
    assert listed[0].problem.code is Code.FLIGHT_UNREADABLE
    assert listed[0].balance is None
    assert listed[1].balance == flight_report.balance(recorded.path)
    with pytest.raises(FlightError, match="no flights folder"):
        flight_report.list_flights(recorded.path / "missing")
