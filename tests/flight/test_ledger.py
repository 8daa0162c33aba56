from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from dappled.clock import RecordedClock
from dappled.daemon.navigation import recorded_doubt, recorded_vehicles
from dappled.flight import FlightError, Frame, Ledger, LedgerReader, Result, ShotRow, ShotState, Stray
from dappled.flight.ledger import advance
from dappled.flight.stored_rows import ledger_damage
from dappled.flight.tables import TRANSITIONS
from tests.flight.makers import CARD_FULL, shot, tag
from tests.standing import STRAY, failure


def ledger_at(path: Path) -> Ledger:
    return Ledger(path, RecordedClock(77))


def frame(index: int) -> Frame:
    return Frame(index, f"frames/{index:06d}.cr2", "IMG_0001.CR2", 3, "ab" * 32, 5)


def test_everything_comes_back_as_it_was_noted(tmp_path: Path) -> None:
    path = tmp_path / "flight.sqlite"
    result = Result(4, "cd" * 32, 12, 13, "geometric", "predicted", 81.5, details={"rms": 0.25})
    stray = Stray("frames/stray-000000.jpg", "A.JPG", 2, "ef" * 32, 6, STRAY)
    with ledger_at(path) as ledger:
        ledger.add_shot(shot(4, sequence=None))
        ledger.add_shot(shot(5))
        ledger.fired(4, 10, 20)
        ledger.safe(frame(4))
        ledger.failed(5, failure("no file came"))
        ledger.add_tag(tag(frame(4)))
        ledger.add_result(result)
        ledger.add_result(replace(result, run="again"))
        ledger.add_stray(stray)
        ledger.add_event("camera", CARD_FULL)
        ledger.set_fact("telemetry_packets", 1)
        ledger.set_fact("telemetry_packets", 2)
    with LedgerReader.open(path) as reader:
        assert reader.shots() == [
            ShotRow(shot(4, sequence=None), "safe", None, 10, 20),
            ShotRow(shot(5), "failed", failure("no file came"), None, None),
        ]
        assert reader.shot(6) is None
        assert reader.frames() == [frame(4)]
        assert reader.frame(4) == frame(4)
        assert reader.frame(5) is None
        assert reader.tag(4) == tag(frame(4)) == reader.tags()[4]
        assert reader.poses()[4] == tag(frame(4)).pose
        assert reader.tag(5) is None
        assert 5 not in reader.poses()
        assert reader.results() == {4: result}
        assert reader.result(4, "again") == replace(result, run="again")
        assert reader.result(4, "never") is None
        assert reader.strays() == [stray]
        assert [(event.utc_ns, event.kind, event.index) for event in reader.events()] == [
            (77, "failed", 5),
            (77, "stray", None),
            (77, "camera", None),
        ]
        facts = reader.facts()
        assert facts.pop("chain") == {"flight": tmp_path.name}
        assert facts == {"telemetry_packets": 2}
        assert ledger_damage(path) is None
        for sha256, text in (*reader.digests("poses").values(), *reader.digests("tags").values()):
            assert hashlib.sha256(text.encode()).hexdigest() == sha256
        with pytest.raises(ValueError, match="no digests"):
            reader.digests("shots")


def test_a_commit_is_durable_by_the_settings_of_sqlite(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        assert ledger._rows("PRAGMA journal_mode") == [("wal",)]
        assert ledger._rows("PRAGMA synchronous") == [(2,)]


def test_a_reader_sees_a_ledger_that_is_written(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger, LedgerReader.open(ledger.path) as reader:
        ledger.add_shot(shot(1))
        assert [row.state for row in reader.shots()] == ["wished"]
        with pytest.raises(FlightError, match="read-only"):
            reader._rows("DELETE FROM shots")


def test_a_closed_ledger_reads_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "flight.sqlite"
    with ledger_at(path) as ledger:
        ledger.add_shot(shot(1))
    connect = sqlite3.connect

    def only_immutable(name: str, **options: Any) -> sqlite3.Connection:
        if "immutable" not in name:
            raise sqlite3.OperationalError("unable to open database file")
        connection: sqlite3.Connection = connect(name, **options)
        return connection

    monkeypatch.setattr(sqlite3, "connect", only_immutable)
    with LedgerReader.open(path) as reader:
        assert len(reader.shots()) == 1


def test_two_frames_or_rows_for_one_shot_are_refused(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        ledger.add_shot(shot(1))
        with pytest.raises(FlightError, match=r"in the ledger .* already"):
            ledger.add_shot(shot(1))
        ledger.safe(frame(1))
        with pytest.raises(FlightError, match="shot 1 is safe: it can't become safe"):
            ledger.safe(frame(1))
        with pytest.raises(FlightError, match="never requested"):
            ledger.safe(frame(2))
        with pytest.raises(FlightError, match="contradicts"):
            ledger.add_tag(tag(frame(2)))
        assert ledger.tags() == {}
        assert ledger.poses() == {}


def test_a_late_file_makes_a_failed_shot_safe(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        ledger.add_shot(shot(1))
        ledger.failed(1, failure("no file came"))
        ledger.safe(frame(1))
        row = ledger.shot(1)
        assert row is not None
        assert (row.state, row.reason) == ("safe", None)
        assert [event.kind for event in ledger.events()] == ["failed", "late"]


@pytest.mark.parametrize("content", [b"", b"no database at all, but long enough" * 100])
def test_a_file_that_is_no_ledger_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "flight.sqlite"
    path.write_bytes(content)
    with pytest.raises(FlightError, match=r"not a dappled ledger|not an SQLite file"):
        LedgerReader.open(path)


def test_foreign_newer_and_missing_ledgers_are_told(tmp_path: Path) -> None:
    foreign, newer = tmp_path / "foreign.sqlite", tmp_path / "newer.sqlite"
    with closing(sqlite3.connect(foreign)) as db, db:
        db.execute("CREATE TABLE notes (a)")
    db.close()
    with pytest.raises(FlightError, match="not a dappled ledger"):
        ledger_at(foreign)
    ledger_at(newer).close()
    with closing(sqlite3.connect(newer)) as db, db:
        db.execute("PRAGMA user_version=99")
    db.close()
    with pytest.raises(FlightError, match=r"version 99, this dappled reads version 1"):
        LedgerReader.open(newer)
    with pytest.raises(FlightError, match="there is no ledger"):
        LedgerReader.open(tmp_path / "missing.sqlite")
    with pytest.raises(FlightError, match="can't be opened"):
        ledger_at(tmp_path / "missing" / "flight.sqlite")


def test_a_damaged_page_is_told(tmp_path: Path) -> None:
    path = tmp_path / "flight.sqlite"
    with ledger_at(path) as ledger:
        for index in range(200):
            ledger.add_shot(shot(index))
    data = bytearray(path.read_bytes())
    data[8192:] = os.urandom(len(data) - 8192)
    path.write_bytes(data)
    assert ledger_damage(path) is not None
    with LedgerReader.open(path) as reader, pytest.raises(FlightError, match="damaged"):
        [*reader.shots(), *reader.frames(), *reader.events(), *reader.facts()]


def test_a_record_that_is_no_record_is_told(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        ledger.add_shot(shot(1))
        ledger.safe(frame(1))
        for text in ("{", "[]", '{"pose":1}', "{}"):
            ledger._rows("INSERT OR REPLACE INTO tags VALUES (1, 'x', ?)", text)
            with pytest.raises(FlightError, match="can't be read"):
                ledger.tags()


def test_a_record_that_is_no_text_is_told(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        for table, read in (("tags", ledger.tags), ("facts", ledger.facts)):
            ledger._rows(f"DROP TABLE {table}")
            ledger._rows(f"CREATE TABLE {table} (idx, key, record, value)")
            ledger._rows(f"INSERT INTO {table} VALUES (1, 'x', NULL, NULL)")  # noqa: S608  a constant
            with pytest.raises(FlightError, match="can't be read"):
                read()


@pytest.mark.parametrize("value", ["null", '"x"', "[[1]]", "1e308", '{"correction_ns": "x"}'])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("began_utc_ns", LedgerReader.began_utc_ns),
        ("utc_correction", LedgerReader.utc_correction_ns),
        ("vehicles", recorded_vehicles),
        ("position_doubt_before", recorded_doubt),
    ],
)
def test_a_fact_of_another_kind_is_told(
    tmp_path: Path, name: str, read: Callable[[LedgerReader], object], value: str
) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        assert not read(ledger)
        ledger._rows("INSERT INTO facts (key, value) VALUES (?, ?)", name, value)
        with pytest.raises(FlightError, match="can't be read"):
            read(ledger)


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    with ledger_at(tmp_path / "flight.sqlite") as ledger:
        ledger._rows("PRAGMA max_page_count = 1")
        with pytest.raises(FlightError, match="the disk is full"):
            ledger.add_event("fill", CARD_FULL.with_facts(fill="x" * 1_000_000))
        ledger._rows("PRAGMA max_page_count = 1000000")
        ledger.add_shot(shot(1))
        assert len(ledger.shots()) == 1


def test_a_closed_ledger_is_told(tmp_path: Path) -> None:
    ledger = ledger_at(tmp_path / "flight.sqlite")
    ledger.close()
    with pytest.raises(FlightError, match="after it was closed"):
        ledger.shots()


STATES: tuple[ShotState, ...] = get_args(ShotState)


@given(st.sampled_from(STATES), st.sampled_from(STATES))
def test_a_shot_goes_only_where_the_table_says(old: ShotState, new: ShotState) -> None:
    if new in TRANSITIONS[old]:
        assert advance(0, old, new) == new
    else:
        with pytest.raises(FlightError):
            advance(0, old, new)


def test_safe_is_final_and_nothing_returns() -> None:
    assert TRANSITIONS["safe"] == frozenset()
    assert all("wished" not in targets for targets in TRANSITIONS.values())


class LedgerAgainstModel(RuleBasedStateMachine):
    """The ledger in memory against a dictionary."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(
            "/dev/shm" if os.path.isdir("/dev/shm") else "/tmp", f"dappled-test-{os.getpid()}-{id(self)}"
        )
        self.folder.mkdir()
        self.ledger = ledger_at(self.folder / "flight.sqlite")
        self.model: dict[int, ShotState] = {}

    def teardown(self) -> None:
        self.ledger.close()
        for file in self.folder.iterdir():
            file.unlink()
        self.folder.rmdir()

    @rule(index=st.integers(0, 3))
    def wished(self, index: int) -> None:
        if index in self.model:
            with pytest.raises(FlightError):
                self.ledger.add_shot(shot(index))
        else:
            self.ledger.add_shot(shot(index))
            self.model[index] = "wished"

    @precondition(lambda self: self.model)
    @rule(index=st.integers(0, 3), new=st.sampled_from(["fired", "safe", "failed"]))
    def moved(self, index: int, new: ShotState) -> None:
        def move() -> None:
            if new == "fired":
                self.ledger.fired(index, 1, 2)
            elif new == "safe":
                self.ledger.safe(frame(index))
            else:
                self.ledger.failed(index, failure("why"))

        if index in self.model and new in TRANSITIONS[self.model[index]]:
            move()
            self.model[index] = new
        else:
            with pytest.raises(FlightError):
                move()

    @invariant()
    def agrees(self) -> None:
        assert {row.shot.index: row.state for row in self.ledger.shots()} == self.model
        assert {each.index for each in self.ledger.frames()} == {i for i, s in self.model.items() if s == "safe"}


TestLedgerAgainstModel = LedgerAgainstModel.TestCase
TestLedgerAgainstModel.settings = settings(max_examples=25, stateful_step_count=15, deadline=None)
