"""What was changed in a ledger with plain SQLite is named, whatever it was."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.flight import FlightFolder, Frame, Ledger, Recording, Result, Stray
from dappled.flight.checks.flight_check import check
from dappled.flight.errors import FlightError
from dappled.flight.tables import KEYS
from tests.flight.makers import CARD_FULL, deliver, held, mavlink_2, request, tag, words_of
from tests.standing import STRAY, failure

SEED = 20261122
EDITS, MANY_EDITS = 12, 50
WORDS = ("of the chain", "chain lacks", "since dappled wrote it", "other than dappled")


@pytest.fixture(scope="module")
def made(begun: Recording) -> FlightFolder:
    """A closed flight with rows in every table."""
    return fly(begun)


def fly(flight: Recording, frames: int = 4) -> FlightFolder:
    for index in range(frames + 2):
        request(flight, index)
    for index in range(frames):
        frame = deliver(flight, index, bytes([index]) * 1000)
        flight.ledger.add_tag(tag(frame))
        flight.ledger.add_result(Result(index, f"{index:064x}", 12, 13, "geometric", "predicted"))
    with held(b"jpeg" * 100) as blob:
        flight.recorder.record_companion(0, "IMG_0001.JPG", blob, arrived_utc_ns=6)
        flight.recorder.record_companion(1, "IMG_0002.JPG", blob, arrived_utc_ns=6)
        for number in range(2):
            flight.recorder.record_stray(f"A{number}.JPG", blob, STRAY, arrived_utc_ns=7)
    flight.ledger.failed(frames, failure("no file came"))
    flight.ledger.follows(frames + 1, failure("its file stays on the camera"))
    flight.ledger.set_fact("vehicles", [[0, 1]])
    flight.learn_utc(1_000, 10, "the autopilot")
    for number in range(40):
        flight.telemetry.append(number, mavlink_2(b"payload" * 3, number))
    flight.close()
    return flight.folder


@contextmanager
def attacked(folder: FlightFolder) -> Iterator[sqlite3.Connection]:
    """The ledger by plain sqlite3; its constraints don't hold an attacker."""
    with closing(sqlite3.connect(folder.ledger)) as db:
        db.execute("PRAGMA foreign_keys=OFF")
        db.execute("PRAGMA ignore_check_constraints=ON")
        yield db
        db.commit()


def edit(db: sqlite3.Connection, table: str, chosen: random.Random) -> str:
    """Change, remove or add one row; says what was done."""
    columns = [(row[1], row[2]) for row in db.execute(f"PRAGMA table_info({table})")]
    rowids = [row[0] for row in db.execute(f"SELECT rowid FROM {table}")]  # noqa: S608  names of the schema
    rowid = chosen.choice(rowids)
    what = chosen.choice(("change", "change", "remove", "add"))
    if what == "remove":
        db.execute(f"DELETE FROM {table} WHERE rowid = ?", (rowid,))  # noqa: S608  names of the schema
        return f"removed row {rowid} of {table}"
    row = list(db.execute(f"SELECT * FROM {table} WHERE rowid = ?", (rowid,)).fetchone())  # noqa: S608  names of the schema
    place = chosen.randrange(len(columns))
    names = ", ".join(name for name, _ in columns)
    if what == "add":
        for number, (name, kind) in enumerate(columns):
            if name in KEYS.get(table, ()) or name in ("name", "number"):
                row[number] = 10**6 + chosen.randrange(10**6) if kind == "INTEGER" else f"new-{chosen.random()}"
        db.execute(f"INSERT INTO {table} ({names}) VALUES ({', '.join('?' * len(row))})", row)  # noqa: S608  names of the schema
        return f"added a row to {table}"
    name, kind = columns[place]
    if name in KEYS.get(table, ()) or name in ("name", "number"):
        new: object = row[place] + 10**6 if kind == "INTEGER" else f"{row[place]}x"
    elif kind == "INTEGER":
        new = (row[place] or 0) + chosen.choice((-1, 1, 1000))
    else:
        new = chosen.choice((f"{row[place]} ", str(row[place])[:-1] + "\x01", "é"))
    db.execute(f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (new, rowid))  # noqa: S608  names of the schema
    return f"{table}.{name} of row {rowid}: {row[place]!r} became {new!r}"


def test_a_flight_with_rows_in_every_table_is_intact(recorded: FlightFolder) -> None:
    with closing(sqlite3.connect(recorded.ledger)) as db:
        for table in (*KEYS, "chain"):
            assert db.execute(f"SELECT count(*) FROM {table}").fetchone()[0] >= 2, table  # noqa: S608  names of the schema
    report = check(recorded.path)
    assert words_of(report.problems) == ()


@pytest.mark.parametrize("edits", [EDITS, pytest.param(MANY_EDITS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("table", [*KEYS, "chain"])
def test_each_edit_of_a_row_is_named(recorded: FlightFolder, table: str, edits: int) -> None:
    chosen = random.Random(f"{SEED} {table}")  # noqa: S311  chances, not secrets
    unseen, before = [], recorded.ledger.read_bytes()
    for _ in range(edits):
        recorded.ledger.write_bytes(before)
        with attacked(recorded) as db:
            done = edit(db, table, chosen)
        problems = words_of(check(recorded.path).problems)
        if not any(words in text for text in problems for words in WORDS):
            unseen.append((done, problems))
    assert not unseen


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE shots SET fired_called_monotonic_ns = 11 WHERE idx = 0",
        "UPDATE frames SET arrived_utc_ns = 6 WHERE idx = 0",
        "UPDATE frames SET camera_name = 'OTHER.CR2' WHERE idx = 0",
        "UPDATE facts SET value = replace(value, '1000', '2000') WHERE key = 'utc_correction'",
        "UPDATE facts SET value = '[[0,2]]' WHERE key = 'vehicles'",
        "DELETE FROM events",
        "DELETE FROM tags",
        "DELETE FROM tags; DELETE FROM poses",
        "DELETE FROM results",
        "DELETE FROM facts WHERE key LIKE 'sha256:%'",
        "DELETE FROM facts WHERE key = 'utc_correction'",
        "UPDATE shots SET reason = 'another one' WHERE state = 'failed'",
        "UPDATE shots SET source = 'mavlink:1/1'; ",
        "UPDATE facts SET value = 'false' WHERE key = 'utc_known'",
        "DELETE FROM chain WHERE number > 40",
        "DELETE FROM chain",
        "DROP TABLE events",
        "CREATE TABLE more (a)",
        "CREATE TRIGGER t AFTER INSERT ON events BEGIN DELETE FROM events; END",
        "ALTER TABLE events ADD COLUMN more TEXT",
        "ALTER TABLE tags RENAME COLUMN record TO words",
    ],
)
def test_an_edit_is_named(recorded: FlightFolder, sql: str) -> None:
    with attacked(recorded) as db:
        db.executescript(sql)
    assert words_of(check(recorded.path).problems)


def test_a_sentence_names_the_row(recorded: FlightFolder) -> None:
    with attacked(recorded) as db:
        db.execute("UPDATE shots SET wished_utc_ns = 7 WHERE idx = 2")
        db.execute("DELETE FROM results WHERE idx = 1")
        db.execute("INSERT INTO events VALUES (77, 1, 'camera', NULL, 'it never was')")
    problems = words_of(check(recorded.path).problems)
    assert "the row of shots 2 was changed since dappled wrote it" in problems
    assert 'the row of results 1,"live" was removed since dappled wrote it' in problems
    assert "the row of events 77 was added by something other than dappled" in problems


def test_a_link_that_does_not_follow_is_named_once(recorded: FlightFolder) -> None:
    with attacked(recorded) as db:
        db.execute("UPDATE chain SET sha256 = ? WHERE number = 25", ("0" * 64,))
    broken = [text for text in words_of(check(recorded.path).problems) if text.startswith("link ")]
    assert len(broken) == 1
    assert "link 25" in broken[0]


def test_rows_of_a_transaction_that_failed_leave_no_link(tmp_path: Path) -> None:
    with Ledger(tmp_path / "flight.sqlite", RecordedClock(77)) as ledger:
        ledger.add_event("camera", CARD_FULL)
        before = ledger.last_link()
        with pytest.raises(Exception, match="never requested"):
            ledger.safe(Frame(9, "frames/000009.cr2", "A.CR2", 1, "ab", 5))
        with pytest.raises(Exception, match="contradicts"):
            ledger.add_companion(Frame(9, "frames/000009.jpg", "A.JPG", 1, "ab", 5))
        assert ledger.last_link() == before
        ledger.add_stray(Stray("frames/stray-000000.jpg", "A.JPG", 1, "ab", 5, STRAY))
        assert ledger.last_link() != before


def test_a_flight_that_lost_its_chain_is_found_out_and_gets_no_new_one(recorded: FlightFolder) -> None:
    with attacked(recorded) as db:
        db.execute("DROP TABLE chain")
        db.execute("DELETE FROM facts WHERE key = 'chain'")
    assert "the chain was removed from the ledger" in words_of(check(recorded.path).problems)
    with pytest.raises(FlightError, match="the chain was removed from the ledger"):
        Ledger(recorded.ledger, RecordedClock(78))
