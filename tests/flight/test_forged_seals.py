"""A flight that was edited by someone who knows the chain and not the key: `flight check` never calls it intact."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.findings import Code
from dappled.flight import FlightError, Ledger, Recording, chain, layout, seal_key, seals
from dappled.flight.checks.flight_check import check
from dappled.flight.seal_key import SealKey
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, mavlink_2, request, words_of


@pytest.fixture
def key(tmp_path: Path) -> SealKey:
    seal_key.make(tmp_path / "key")
    return seal_key.load(tmp_path / "key")


@pytest.fixture
def sealed(flight: Recording, key: SealKey) -> Path:
    """A closed flight of two frames, signed."""
    for index in range(2):
        request(flight, index)
        deliver(flight, index, b"raw %d" % index * 1000)
    flight.telemetry.append(1, mavlink_2(b"a"))
    flight.close()
    seals.seal(layout.open_folder(flight.folder.path), RecordedClock(START_UTC_NS), seals.Occasion.GEOTAG, key)
    return flight.folder.path


class Forger:
    """Writes rows and the links that make the chain consistent with them."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def write(self, table: str, column: str, key: str, sql: str, *values: object) -> None:
        self._db.execute(sql, values)
        row = self._db.execute(f"SELECT * FROM {table} WHERE {column}=?", (key,)).fetchone()  # noqa: S608
        number, link = self._db.execute("SELECT number, link FROM chain ORDER BY number DESC LIMIT 1").fetchone()
        last = chain.ChainLink(number, "", "", "", link)
        made = chain.follow(last, table, chain.json_array([key]), chain.row_digest(row))
        values = (made.number, made.subject, made.key, made.sha256, made.link)
        self._db.execute("INSERT INTO chain VALUES (?, ?, ?, ?, ?)", values)

    def fact(self, key: str, value: object) -> None:
        self.write("facts", "key", key, "INSERT OR REPLACE INTO facts VALUES (?, ?)", key, json.dumps(value))


@contextmanager
def forging(flight: Path) -> Iterator[Forger]:
    with closing(sqlite3.connect(flight / "flight.sqlite")) as db:
        yield Forger(db)
        db.commit()
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def test_a_signed_flight_is_vouched_for(sealed: Path, key: SealKey) -> None:
    found = check(sealed, key)
    assert (words_of(found.problems), found.vouched) == ((), "signed")


def test_links_after_the_signed_seal_are_not_vouched_for(sealed: Path, key: SealKey) -> None:
    with forging(sealed) as forger:
        forger.fact("utc_correction", {"correction_ns": 86_400 * 10**9})
    found = check(sealed, key)
    assert found.vouched == "not signed"
    assert (found.verdict.code, found.verdict.facts["key"]) == (Code.SEAL_SIGNED_UNTIL, key.name)


@pytest.mark.parametrize("name", ["flight.toml", "shots.jsonl"])
def test_a_recorded_file_never_changes_after_a_seal(sealed: Path, key: SealKey, name: str) -> None:
    path = sealed / name
    path.write_bytes(path.read_bytes() + b"\n")
    with forging(sealed) as forger:
        forger.fact(f"sha256:{name}", [hashlib.sha256(path.read_bytes()).hexdigest()])
    assert any(name in text for text in words_of(check(sealed, key).problems))


def test_frames_are_missed_whatever_a_fact_says(sealed: Path, key: SealKey) -> None:
    with forging(sealed) as forger:
        forger.fact("offloaded", {"files": 2, "destination": "/elsewhere"})
    for path in (sealed / "frames").glob("*.cr2"):
        path.unlink()
    assert sum("the file is missing" in text for text in words_of(check(sealed, key).problems)) == 2


@pytest.mark.parametrize("count", [10**6, 10**12])
def test_a_count_of_seals_takes_no_memory(sealed: Path, key: SealKey, count: int) -> None:
    with forging(sealed) as forger:
        forger.fact("seals", {"count": count, "missing": []})
    assert any(f"tells of {count} seals" in text for text in words_of(check(sealed, key).problems))


@pytest.mark.parametrize(
    "sql",
    [
        "WITH RECURSIVE n(i) AS (VALUES (1) UNION ALL SELECT i + 1 FROM n) SELECT i, i, i, i, i FROM n",
        "SELECT hex(zeroblob(400000000)), 1, 1, 1, 1",
    ],
    ids=["endless", "large"],
)
def test_a_view_in_place_of_a_table_is_refused(sealed: Path, key: SealKey, sql: str) -> None:
    with closing(sqlite3.connect(sealed / "flight.sqlite")) as db:
        db.execute("DROP TABLE strays")
        db.execute(f"CREATE VIEW strays AS {sql}")
        db.commit()
    assert any("the view 'strays'" in text for text in words_of(check(sealed, key).problems))


@pytest.mark.parametrize(
    ("sql", "words"),
    [
        ("CREATE TABLE strays (a, b, c, d, e AS (hex(zeroblob(8000000))))", "the computed column 'e'"),
        ("CREATE VIRTUAL TABLE strays USING rtree(a, b, c)", "the virtual table 'strays'"),
        ("CREATE TRIGGER mine AFTER INSERT ON facts BEGIN DELETE FROM frames; END", "the trigger 'mine'"),
    ],
    ids=["column", "virtual", "trigger"],
)
def test_a_ledger_that_computes_is_neither_read_nor_written(sealed: Path, key: SealKey, sql: str, words: str) -> None:
    """A thousand rows of such a column are 16 GB, and a trigger would do what it likes when a seal is added."""
    ledger = sealed / "flight.sqlite"
    with closing(sqlite3.connect(ledger)) as db:
        if "strays" in sql:
            db.execute("DROP TABLE strays")
        db.execute(sql)
        db.commit()
    assert any(words in text for text in words_of(check(sealed, key).problems))
    with pytest.raises(FlightError, match=words):
        Ledger(ledger, RecordedClock(START_UTC_NS))
