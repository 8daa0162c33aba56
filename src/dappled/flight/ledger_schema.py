"""The ledger's tables, and its rows as records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from dappled.decode.geometry.pose import Gnss, Pose
from dappled.flight.entries import Result, ShotRow
from dappled.flight.records import Cause, Shot, ShotState, Tag

LIVE = "live"
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
"""


def shot_row(row: Sequence[Any]) -> ShotRow:
    """A row of `shots`."""
    index, source, kind, sequence, utc_ns, monotonic_ns, state, reason, called, returned = row
    shot = Shot(index, Cause(source, kind, sequence), utc_ns, monotonic_ns)
    return ShotRow(shot, cast(ShotState, state), reason, called, returned)


def pose(value: dict[str, Any]) -> Pose:
    """A record of `poses`. Raises TypeError for what is none."""
    made: dict[str, Any] = {key: tuple(item) for key, item in value.items() if isinstance(item, list)}
    if value.get("gnss") is not None:
        made["gnss"] = Gnss(**value["gnss"])
    return Pose(**{**value, **made})


def tag(value: dict[str, Any]) -> Tag:
    """A record of `tags`. Raises TypeError or KeyError for what is none."""
    return Tag(**{**value, "pose": pose(value["pose"])})


def result(value: dict[str, Any]) -> Result:
    """A record of `results`. Raises TypeError for what is none."""
    return Result(**value)
