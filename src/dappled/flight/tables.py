"""The tables of a ledger, with the keys of their rows, and the states that a shot may go through."""

from __future__ import annotations

from dappled.flight.records import ShotState

APPLICATION_ID = 0x4450504C  # "DPPL"
SCHEMA_VERSION = 1

SCHEMA = """
CREATE TABLE shots (
    idx INTEGER PRIMARY KEY,           -- the image index, going on over flights
    source TEXT NOT NULL, kind TEXT NOT NULL, sequence INTEGER,
    wished_utc_ns INTEGER NOT NULL, wished_monotonic_ns INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('wished', 'fired', 'safe', 'failed')),
    reason TEXT,
    fired_called_monotonic_ns INTEGER, fired_returned_monotonic_ns INTEGER
) STRICT;
CREATE TABLE frames (
    idx INTEGER PRIMARY KEY REFERENCES shots (idx),
    name TEXT NOT NULL UNIQUE,         -- relative to the flight folder
    camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, arrived_utc_ns INTEGER NOT NULL
) STRICT;
CREATE TABLE strays (
    name TEXT PRIMARY KEY, camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL,
    arrived_utc_ns INTEGER NOT NULL, reason TEXT NOT NULL
) STRICT;
CREATE TABLE companions (             -- the JPEG beside a raw frame
    name TEXT PRIMARY KEY, idx INTEGER NOT NULL REFERENCES frames (idx),
    camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, arrived_utc_ns INTEGER NOT NULL
) STRICT;
CREATE TABLE poses (idx INTEGER PRIMARY KEY REFERENCES frames (idx), sha256 TEXT NOT NULL, record TEXT NOT NULL) STRICT;
CREATE TABLE tags (idx INTEGER PRIMARY KEY REFERENCES frames (idx), sha256 TEXT NOT NULL, record TEXT NOT NULL) STRICT;
CREATE TABLE results (
    idx INTEGER NOT NULL REFERENCES frames (idx), run TEXT NOT NULL,
    slices_sha256 TEXT NOT NULL, record TEXT NOT NULL,
    PRIMARY KEY (idx, run)
) STRICT;
CREATE TABLE events (
    number INTEGER PRIMARY KEY, utc_ns INTEGER NOT NULL, kind TEXT NOT NULL, idx INTEGER, text TEXT NOT NULL
) STRICT;
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE chain (
    number INTEGER PRIMARY KEY,        -- from 1, without gaps
    subject TEXT NOT NULL,             -- a table, or a file that is appended to
    key TEXT NOT NULL,                 -- JSON array: the row's primary key, or the first byte and the end of a block
    sha256 TEXT NOT NULL,              -- of the row as JSON array of its columns, or of the block's bytes
    link TEXT NOT NULL                 -- SHA-256 of the link before, number, subject, key, sha256, a line break between
) STRICT;
"""
KEYS: dict[str, tuple[str, ...]] = {  # the primary key of each table that the chain covers
    "shots": ("idx",),
    "frames": ("idx",),
    "strays": ("name",),
    "companions": ("name",),
    "poses": ("idx",),
    "tags": ("idx",),
    "results": ("idx", "run"),
    "events": ("number",),
    "facts": ("key",),
}
ROW_OF = {  # SQL that reads one row by its key
    table: f"SELECT * FROM {table} WHERE {' AND '.join(f'{column} = ?' for column in key)}"  # noqa: S608  constants
    for table, key in KEYS.items()
}
LINKS = "SELECT number, subject, key, sha256, link FROM chain"
CHANGED_LATER = frozenset({"shots", "facts"})  # tables whose rows are updated; rows of the others stay as they are
TELEMETRY = "telemetry.tlog"  # the subject of its blocks
DEFINITIONS = "sqlite_master"  # the subject of the tables' own definitions
# The life of a shot: wished → fired → safe | failed. A file is proof of an exposure: it makes a shot safe even when the
# trigger call was not seen to return, and even when the shot had been given up. What is safe stays safe.
TRANSITIONS: dict[ShotState, frozenset[ShotState]] = {
    "wished": frozenset({"fired", "safe", "failed"}),
    "fired": frozenset({"safe", "failed"}),
    "failed": frozenset({"safe"}),
    "safe": frozenset(),
}
