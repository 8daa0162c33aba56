"""What docs/flight-data.md says is enough: its reader, with the standard library alone, reads a flight."""

from __future__ import annotations

import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.decode.geometry import Pose
from dappled.flight import LedgerReader, Tag, recording
from dappled.flight.tables import SCHEMA
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, flip, pose, request, tag
from tests.standing import failure

DOCUMENT = Path(__file__).parents[2] / "docs" / "flight-data.md"


@pytest.fixture
def flight(flights: Path) -> Path:
    """Two frames, of which one has a position; and a failed shot."""
    begun = recording.begin(flights, RecordedClock(START_UTC_NS))
    for index in range(3):
        request(begun, index)
    known = tag(deliver(begun, 0, b"raw 0"))
    begun.ledger.add_tag(replace(known, utc_ns=START_UTC_NS, pose=replace(pose(), position_sigma_m=0.8)))
    deliver(begun, 1, b"raw 1")
    begun.ledger.failed(2, failure("the camera was gone"))
    begun.close()
    return begun.folder.path


def read(flight: Path, example: int = 0) -> list[str]:
    code = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)[example]
    command = [sys.executable, "-I", "-S", "-c", code, str(flight)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_reader_in_the_document_reads_a_flight(flight: Path) -> None:
    first, second, third = read(flight)
    assert first == (
        "     0 frames/000000.cr2 intact 2026-11-21T10:15:03+00:00 41.6311134 -91.5414669 215.1 m ± 0.80 m"
    )
    assert second == "     1 frames/000001.cr2 intact"
    assert third == "     2 failed: shot.failed {'reason': 'the camera was gone'}"
    flip(flight / "frames" / "000001.cr2", 2)
    assert read(flight)[1].endswith("CHANGED")


def test_the_second_reader_follows_the_chain(flight: Path) -> None:
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        head = ledger.last_link()
    assert head is not None
    (line,) = read(flight, 1)
    assert line.endswith(f"rows, the last link is {head.link}")
    with closing(sqlite3.connect(flight / "flight.sqlite")) as db, db:
        db.execute("UPDATE shots SET wished_utc_ns = 9 WHERE idx = 1")
        db.execute("DELETE FROM events WHERE number = 1")
        db.execute("UPDATE chain SET key = '[9]' WHERE number = 30")
    db.close()
    said = read(flight, 1)
    assert {"changed, added or removed: shots [1]", "changed, added or removed: events [1]"} <= set(said)
    assert "link 30 does not follow" in said


def test_the_document_names_every_table_and_every_key(flight: Path) -> None:
    text = DOCUMENT.read_text()
    for table, columns in re.findall(r"CREATE TABLE (\w+) \((.*?)\n?\) STRICT", SCHEMA, re.DOTALL):
        assert f"`{table}`" in text
        for column in re.findall(r"(?:^|,)\s*(\w+) (?:TEXT|INTEGER)", re.sub(r"--.*", "", columns)):
            assert re.search(rf"`[^`]*\b{column}\b[^`]*`", text), f"{table}.{column}"
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        for key in ledger.facts():
            assert f"`{key}`" in text
    for record in (Pose, Tag):
        for name in record.__dataclass_fields__:
            assert f"`{name}`" in text, f"{record.__name__}.{name}"


def test_the_shell_lines_in_the_document_check_a_tag(flight: Path) -> None:
    if shutil.which("sqlite3") is None:
        pytest.skip("the command sqlite3 is not installed")
    lines = [line for line in DOCUMENT.read_text().splitlines() if line.startswith("sqlite3 ")]
    assert len(lines) == 2
    said = [
        subprocess.run(
            ["/bin/sh", "-c", line.replace("idx=42", "idx=0")], cwd=flight, capture_output=True, text=True, check=True
        ).stdout.split()[0]
        for line in lines
    ]
    with closing(sqlite3.connect(flight / "flight.sqlite")) as ledger, ledger:
        (sha256,) = ledger.execute("SELECT sha256 FROM tags WHERE idx = 0").fetchone()
    ledger.close()
    assert said == [sha256, sha256]
