"""The index over all flights: the flight and the frame of each image index.

The camera's image index goes on over restarts. The index is made from the flights' own ledgers and can be rebuilt from
them at any time. It alone remembers which shots' outcomes were reported to the ground station: one that is rebuilt has
those of flights that were cut short to report, and none of others.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from dappled import confined
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import layout, log_reading
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Database, LedgerReader, moved_aside
from dappled.flight.records import ShotState

FILE_NAME = "index.sqlite"
_APPLICATION_ID = 0x44505049  # "DPPI"
_VERSION = 1
_SCHEMA = f"""
BEGIN IMMEDIATE;
PRAGMA application_id={_APPLICATION_ID};
PRAGMA user_version={_VERSION};
CREATE TABLE flights (
    number INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, start_utc_ns INTEGER, sealed INTEGER NOT NULL DEFAULT 0,
    highest INTEGER                    -- image index that anything in a sealed flight mentions, strays too
) STRICT;
CREATE TABLE images (
    idx INTEGER PRIMARY KEY, flight TEXT NOT NULL REFERENCES flights (name), frame TEXT, state TEXT NOT NULL
) STRICT;
-- The shots whose outcomes were reported stand in the first until their flight is sealed, the others in the second then
CREATE TABLE reported (idx INTEGER PRIMARY KEY) STRICT;
CREATE TABLE unreported (idx INTEGER PRIMARY KEY, counted INTEGER NOT NULL DEFAULT 0) STRICT;
COMMIT;
"""


@dataclass(frozen=True, slots=True)
class IndexEntry:
    """The flight of an image index, the frame's name in it (None without a frame), and the shot's state."""

    index: int
    flight: str
    frame: str | None
    state: ShotState


class ImageIndex(Database):
    """`<flights>/index.sqlite`, open for reading and writing by the one daemon that holds the flights' lock."""

    def __init__(self, root: Path) -> None:
        """Open or make the index. Raises FlightError when it is damaged or foreign: see `open_or_rebuild`."""
        self.root = root
        path = root / FILE_NAME
        super().__init__(path, f"{path.absolute().as_uri()}?mode=rwc")

    def _identify(self) -> None:
        empty, application, version = self._identity()
        if not (empty and application == 0) and (application, version) != (_APPLICATION_ID, _VERSION):
            raise FlightError(
                f"{self.path} is not an index that this dappled can read; move it away, and it will be rebuilt"
            )
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=NORMAL")  # the ledgers are the truth: a lost row is found again there
        if empty:
            self._db.executescript(_SCHEMA)

    def _sentence(self, error: sqlite3.Error | UnicodeDecodeError) -> FlightError:
        if getattr(error, "sqlite_errorname", "") == "SQLITE_CANTOPEN":
            return FlightError(f"cannot open the index {self.path}: {error}; check its folder")
        return FlightError(f"cannot use the index {self.path}: {error}; move it away, and it will be rebuilt")

    def add_flight(self, name: str, start_utc_ns: int | None) -> None:
        """Add a flight that starts at this UTC. Where UTC is not known yet (None), call this again later."""
        self._rows(
            "INSERT INTO flights (name, start_utc_ns) VALUES (?, ?) ON CONFLICT (name) DO UPDATE "
            "SET start_utc_ns = coalesce(excluded.start_utc_ns, start_utc_ns)",
            name,
            start_utc_ns,
        )

    def put(self, entry: IndexEntry) -> None:
        """Set the entry of an image index. Raises FlightError when the index belongs to another flight."""
        held = self.lookup(entry.index)
        if held is not None and held.flight != entry.flight:
            raise FlightError(
                f"image {entry.index} is in flight {held.flight} and again in {entry.flight}: the first one is used"
            )
        values = (entry.index, entry.flight, entry.frame, entry.state)
        self._rows("INSERT OR REPLACE INTO images VALUES (?, ?, ?, ?)", *values)

    def lookup(self, index: int) -> IndexEntry | None:
        """The entry of an image index; None when no flight has it."""
        rows = self._rows("SELECT idx, flight, frame, state FROM images WHERE idx = ?", index)
        return None if not rows else IndexEntry(rows[0][0], rows[0][1], rows[0][2], cast(ShotState, rows[0][3]))

    def flight(self, name: str) -> FlightFolder:
        """The folder of a flight in the index. Raises OutsideError for a name that leads out of the flights folder."""
        return FlightFolder(confined.path(self.root, name, f"the index {self.path}"))

    def highest(self) -> int | None:
        """The highest image index in the index, or mentioned by a sealed flight."""
        rows = self._rows("SELECT max(idx) FROM images UNION ALL SELECT max(highest) FROM flights")
        return max((row[0] for row in rows if row[0] is not None), default=None)

    def flights(self) -> dict[str, int | None]:
        """The flights in the order they were flown, with their starts (UTC, ns) where known."""
        return dict(self._rows("SELECT name, start_utc_ns FROM flights ORDER BY number"))

    def sealed(self) -> set[str]:
        """The flights that are closed and fully indexed."""
        return {row[0] for row in self._rows("SELECT name FROM flights WHERE sealed")}

    def take_in(self, folder: FlightFolder, *, seal: bool, cut_short: bool = False) -> list[Finding]:
        """Index all shots of a flight from its ledger. `seal`: no more shots will come. Returns what was found.

        A sealed flight that had a MAVLink link leaves its unreported shots behind, if this index saw it begin. One that
        was `cut_short` does so in any case: an index that lost its reports makes them once more."""
        problems: list[Finding] = []
        known = cut_short or folder.name in self.flights()
        reports = known and folder.telemetry.exists() and folder.telemetry.stat().st_size > 0
        with LedgerReader.open(folder.ledger) as ledger:
            correction_ns, began_utc_ns = ledger.utc_correction_ns(), ledger.began_utc_ns()
            start_utc_ns = None if correction_ns is None or began_utc_ns is None else began_utc_ns + correction_ns
            self.add_flight(folder.name, start_utc_ns)
            frames = {frame.index: frame.name for frame in ledger.frames()}
            for row in ledger.shots():
                index = row.shot.index
                try:
                    self.put(IndexEntry(index, folder.name, frames.get(index), row.state))
                except FlightError as error:
                    problems.append(finding(Code.INDEX_TAKEN, Subject("flight", folder.name), why=error))
        if seal:
            self._seal(folder, reports=reports)
        return problems

    def _seal(self, folder: FlightFolder, *, reports: bool) -> None:
        """Mark a flight as sealed, and in the same transaction its shots that were not reported."""
        highest = highest_in(folder)
        with self._lock, self._speaking(), self._db:
            self._db.execute("BEGIN IMMEDIATE")
            if reports:
                self._db.execute(
                    "INSERT OR IGNORE INTO unreported (idx) SELECT idx FROM images WHERE flight = ? "
                    "AND idx NOT IN (SELECT idx FROM reported)",
                    (folder.name,),
                )
            self._db.execute(
                "DELETE FROM reported WHERE idx IN (SELECT idx FROM images WHERE flight = ?)", (folder.name,)
            )
            self._db.execute("UPDATE flights SET sealed = 1, highest = ? WHERE name = ?", (highest, folder.name))

    def note_reported(self, index: int) -> None:
        """The outcome of a shot was sent to the ground station. Survives the death of the process, not always a power
        cut: then it is sent once more."""
        self._rows("INSERT OR IGNORE INTO reported VALUES (?)", index)

    def unreported(self) -> dict[int, bool]:
        """The shots of sealed flights whose outcomes were not reported, in their order, and whether a text to the pilot
        has counted each."""
        return {index: bool(said) for index, said in self._rows("SELECT idx, counted FROM unreported ORDER BY idx")}

    def note_counted(self) -> None:
        """A text to the pilot has counted all unreported shots."""
        self._rows("UPDATE unreported SET counted = 1")

    def note_late_report(self, index: int) -> None:
        """The outcome of a shot of a sealed flight was sent to the ground station."""
        self._rows("DELETE FROM unreported WHERE idx = ?", index)

    def next_index(self) -> int:
        """The image index of the next shot, from 0: above everything in the index, and above what the ledger, journal
        and frames of each unsealed flight mention."""
        sealed = self.sealed()
        open_flights = [folder for folder in layout.flights(self.root) if folder.name not in sealed]
        known = [self.highest(), *(highest_in(folder) for folder in open_flights)]
        return max((index for index in known if index is not None), default=-1) + 1


def open_or_rebuild(root: Path) -> tuple[ImageIndex, list[Finding]]:
    """Open the index; a damaged one is moved aside and replaced by an empty one, to be filled from the ledgers.

    Returns the index and what was done. Raises FlightError when no index can be opened or made.
    """
    try:
        return ImageIndex(root), []
    except FlightError as error:
        path = root / FILE_NAME
        if not path.is_file():
            raise
        with disk_errors("move away the damaged index", path):
            aside = moved_aside(path)
        return ImageIndex(root), [finding(Code.INDEX_REBUILT, Subject("flights"), why=error, aside=aside.name)]


def in_order(root: Path) -> list[FlightFolder]:
    """All flights under `root` in the order they were flown. Names need not show that order: the clock may have been
    set back, or unknown. Flights that are not in the index come first, by name. Raises FlightError."""
    known: list[str] = []
    if (root / FILE_NAME).is_file():
        try:
            with closing(sqlite3.connect(f"{(root / FILE_NAME).absolute().as_uri()}?mode=rw", uri=True)) as index:
                known = [row[0] for row in index.execute("SELECT name FROM flights ORDER BY number")]
        except sqlite3.Error:  # damaged, or not writable: order by name
            known = []
    place = {name: number for number, name in enumerate(known)}
    return sorted(layout.flights(root), key=lambda folder: place.get(folder.name, -1))


def highest_in(folder: FlightFolder) -> int | None:
    """The highest image index that a flight's journal, ledger or frames mention; a damaged ledger is skipped."""
    found = [shot.index for shot in log_reading.read_journal(folder.journal).shots]
    try:
        with LedgerReader.open(folder.ledger) as ledger:
            found += [row.shot.index for row in ledger.shots()]
    except FlightError:  # recovery has reported it; the journal and the frames' names say enough here
        pass
    if folder.frames.is_dir():
        found += [index for name in os.listdir(folder.frames) if (index := layout.index_of(name)) is not None]
    return max(found, default=None)
