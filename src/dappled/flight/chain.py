"""The hash chain of a ledger: each link covers what was written, and the link before it.

The chain shows whether a row was changed, removed or added by anything but dappled. It is no proof against a person
who computes it anew; a seal signed with a key is (`seals`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dappled import codec
from dappled.decode.geometry import Pose
from dappled.flight.records import Tag

Column = str | int | float | bytes | None


@dataclass(frozen=True, slots=True)
class ChainLink:
    """One link. `subject` is a table of the ledger or a file; `key` says which row of it, or which bytes (JSON).

    `sha256` is of the row as a JSON array of its columns, or of the bytes. `link` is what the next one builds on.
    """

    number: int
    subject: str
    key: str
    sha256: str
    link: str


def digest(record: Pose | Tag | Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a record's canonical form."""
    return hashlib.sha256(codec.canonical(record)).hexdigest()


def json_array(values: Sequence[Column]) -> str:
    """Values of a row, or its primary key, as SQLite's json_array() gives them."""
    return _ENCODER.encode(values)


def row_digest(row: Sequence[Column]) -> str:
    """SHA-256 (hex) of a row: of its columns as a JSON array, in the table's order."""
    return hashlib.sha256(json_array(row).encode("utf-8", "surrogateescape")).hexdigest()


def follow(last: ChainLink | None, subject: str, key: str, sha256: str) -> ChainLink:
    """The next link after `last` (None: the first one)."""
    number, before = (1, "") if last is None else (last.number + 1, last.link)
    text = f"{before}\n{number}\n{subject}\n{key}\n{sha256}"
    return ChainLink(number, subject, key, sha256, hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest())


def _hex(value: object) -> str:
    """Bytes where the schema allows none: only a damaged file has them."""
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"{type(value).__name__} is not a column of the ledger")


_ENCODER = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False, default=_hex)
