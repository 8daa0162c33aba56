"""Compare the telemetry log with the blocks of it that the chain covers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from dappled import durable
from dappled.bounds.parsing import check_stored
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight.chain import ChainLink
from dappled.flight.errors import disk_errors
from dappled.flight.tables import TELEMETRY


def compare(path: Path, links: Mapping[int, ChainLink]) -> Iterator[Finding]:
    """The blocks of the log that differ from their links. Raises FlightError when it can't be read."""
    blocks = [link for link in links.values() if link.subject == TELEMETRY]
    if not blocks:
        return
    about = Subject("file", path.name)
    with disk_errors("read the telemetry", path):
        try:
            with open(path, "rb", opener=durable.plain_file) as file:
                size = check_stored(file.fileno())
                for link in blocks:
                    start, end = _range(link.key)
                    file.seek(min(start, size))
                    if hashlib.sha256(file.read(min(end, size) - min(start, size))).hexdigest() != link.sha256:
                        yield finding(Code.TELEMETRY_BLOCK_CHANGED, about, name=path.name, start=start, end=end)
        except FileNotFoundError:
            yield finding(Code.TELEMETRY_BLOCKS_MISSING, about, name=path.name, blocks=len(blocks))


def _range(key: str) -> tuple[int, int]:
    """First byte and end of a block; an empty one where the link was damaged, which its chain tells."""
    try:
        start, end = json.loads(key)
    except (ValueError, TypeError, RecursionError):
        return 0, 0
    whole = type(start) is int and type(end) is int and 0 <= start <= end
    return (start, end) if whole else (0, 0)
